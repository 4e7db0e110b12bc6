/* The observer as a co-simulation FMU, FMI 3.0. Types and functions are those of the standard [fmi-standard.org]. */
#include "nnap.h"

#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

typedef enum { fmi3OK, fmi3Warning, fmi3Discard, fmi3Error, fmi3Fatal } fmi3Status;
typedef const char *text;
typedef void (*log_message)(void *, fmi3Status, text, text);

enum { N = nnap_upper_STATES, M = nnap_upper_READINGS, C = nnap_upper_INPUTS, P = nnap_upper_PARAMETERS };
enum { READINGS = 1 + C, MEAN = READINGS + M, STD = MEAN + N, INNOVATION = STD + N, MISFIT = INNOVATION + M, WEIGHT,
       PARAMETER, FLAGS = PARAMETER + P };

typedef struct {
    nnap_state state, ahead;
    nnap_real u[C + 1], before[C + 1], y[M], parameter[P + 1];
    double time;
    int flags;
    void *environment;
    log_message log;
} instance;

static fmi3Status failed(instance *f, text reason)
{
    if (f->log) f->log(f->environment, fmi3Error, "logStatusError", reason);
    return fmi3Error;
}

static void begin(instance *f, double time)
{
    f->time = time;
    nnap_start(&f->state, time);
    memcpy(f->state.parameter, f->parameter, P * sizeof(nnap_real));
    f->ahead = f->state;
    f->flags = 0;
}

static void reset(instance *f)
{
    nnap_start(&f->state, 0);
    memcpy(f->parameter, f->state.parameter, P * sizeof(nnap_real));
    for (int i = 0; i < C; i++) f->u[i] = f->before[i] = 0;
    for (int i = 0; i < M; i++) f->y[i] = NAN;
    begin(f, 0);
}

EXPORT text fmi3GetVersion(void) { return "3.0"; }

EXPORT void *fmi3InstantiateCoSimulation(text name, text token, text resources, bool visible, bool logging, bool events,
                                         bool early, const unsigned *variables, size_t count, void *environment,
                                         log_message log, void *update)
{
    instance *f;
    (void)name, (void)resources, (void)visible, (void)logging, (void)early, (void)variables, (void)count, (void)update;
    if (events || strcmp(token, "nnap_token")) return NULL;
    f = calloc(1, sizeof(instance));
    if (!f) return NULL;
    f->environment = environment;
    f->log = log;
    reset(f);
    return f;
}

EXPORT void fmi3FreeInstance(void *f) { free(f); }

EXPORT fmi3Status fmi3Reset(void *f)
{
    reset(f);
    return fmi3OK;
}

EXPORT fmi3Status fmi3EnterInitializationMode(void *f, bool tolerance, double value, double start, bool stop, double end)
{
    (void)tolerance, (void)value, (void)stop, (void)end;
    begin(f, start);
    return fmi3OK;
}

EXPORT fmi3Status fmi3ExitInitializationMode(void *f)
{
    begin(f, ((instance *)f)->time);
    return fmi3OK;
}

EXPORT fmi3Status fmi3SetDebugLogging(void *f, bool on, size_t count, const text *categories)
{
    (void)f, (void)on, (void)count, (void)categories;
    return fmi3OK;
}

EXPORT fmi3Status fmi3Terminate(void *f)
{
    (void)f;
    return fmi3OK;
}

EXPORT fmi3Status fmi3GetFloat64(void *x, const unsigned *places, size_t count, double *values, size_t size)
{
    instance *f = x;
    if (size != count) return failed(f, "arrays are not known here");
    for (size_t k = 0; k < count; k++) {
        const int i = (int)places[k];
        if (i == 0) values[k] = f->time;
        else if (i < READINGS) values[k] = f->u[i - 1];
        else if (i < MEAN) values[k] = f->y[i - READINGS];
        else if (i < STD) values[k] = f->ahead.mean[i - MEAN];
        else if (i < INNOVATION) values[k] = f->ahead.std[i - STD];
        else if (i < MISFIT) values[k] = f->state.innovation[i - INNOVATION];
        else if (i == MISFIT) values[k] = f->state.misfit;
        else if (i == WEIGHT) values[k] = f->state.weight;
        else if (i < FLAGS) values[k] = f->parameter[i - PARAMETER];
        else return failed(f, "unknown value reference");
    }
    return fmi3OK;
}

EXPORT fmi3Status fmi3SetFloat64(void *x, const unsigned *places, size_t count, const double *values, size_t size)
{
    instance *f = x;
    if (size != count) return failed(f, "arrays are not known here");
    for (size_t k = 0; k < count; k++) {
        const int i = (int)places[k];
        const nnap_real value = (nnap_real)values[k];
        if (i > 0 && i < READINGS) f->u[i - 1] = value;
        else if (i >= READINGS && i < MEAN) f->y[i - READINGS] = value;
        else if (i >= PARAMETER && i < FLAGS && isfinite(value)) f->parameter[i - PARAMETER] = value;
        else return failed(f, "no variable that may be set to this value");
    }
    return fmi3OK;
}

EXPORT fmi3Status fmi3GetInt32(void *x, const unsigned *places, size_t count, int32_t *values, size_t size)
{
    instance *f = x;
    for (size_t k = 0; k < count; k++) {
        if (places[k] != FLAGS || size != count) return failed(f, "unknown value reference");
        values[k] = f->flags;
    }
    return fmi3OK;
}

/* Readings of the time `from` count; what is shown is the prediction of the end of the step. */
EXPORT fmi3Status fmi3DoStep(void *x, double from, double step, bool keep, bool *event, bool *terminate, bool *early,
                             double *last)
{
    instance *f = x;
    const double rows = rint(step / nnap_dt);
    nnap_real nothing[M];
    (void)keep;
    *event = *terminate = *early = false;
    *last = from;
    if (!(rows >= 1 && rows < 1e6 && fabs(step / nnap_dt - rows) < 1e-3))
        return failed(f, "the step is no multiple of nnap_dt s, the rows of the logs");
    for (int i = 0; i < M; i++) nothing[i] = NAN;
    f->flags = nnap_step(&f->state, from, f->before, f->y);
    memcpy(f->before, f->u, sizeof(f->u));
    f->ahead = f->state;
    for (int k = 0; k < (int)rows; k++) nnap_step(&f->ahead, NAN, f->u, nothing);
    *last = f->time = from + step;
    return fmi3OK;
}

#define ABSENT(name) EXPORT fmi3Status fmi3##name(void) { return fmi3Error; }
#define VALUES(type) ABSENT(Get##type) ABSENT(Set##type)
VALUES(Float32) VALUES(Int8) VALUES(UInt8) VALUES(Int16) VALUES(UInt16) VALUES(UInt32) VALUES(Int64) VALUES(UInt64)
VALUES(Boolean) VALUES(String) VALUES(Binary) VALUES(Clock) VALUES(IntervalDecimal) VALUES(IntervalFraction)
VALUES(ShiftDecimal) VALUES(ShiftFraction) VALUES(ContinuousStates)
ABSENT(SetInt32) ABSENT(EnterEventMode) ABSENT(EnterStepMode) ABSENT(EnterConfigurationMode)
ABSENT(ExitConfigurationMode) ABSENT(GetNumberOfVariableDependencies) ABSENT(GetVariableDependencies)
ABSENT(GetFMUState) ABSENT(SetFMUState) ABSENT(FreeFMUState)
ABSENT(SerializedFMUStateSize) ABSENT(SerializeFMUState) ABSENT(DeserializeFMUState) ABSENT(GetDirectionalDerivative)
ABSENT(GetAdjointDerivative) ABSENT(EvaluateDiscreteStates) ABSENT(UpdateDiscreteStates) ABSENT(SetTime)
ABSENT(EnterContinuousTimeMode) ABSENT(CompletedIntegratorStep) ABSENT(GetContinuousStateDerivatives)
ABSENT(GetEventIndicators) ABSENT(GetNominalsOfContinuousStates) ABSENT(GetNumberOfEventIndicators)
ABSENT(GetNumberOfContinuousStates) ABSENT(GetOutputDerivatives) ABSENT(ActivateModelPartition)

EXPORT void *fmi3InstantiateModelExchange(void) { return NULL; }
EXPORT void *fmi3InstantiateScheduledExecution(void) { return NULL; }
