/* Torque of a joint at a velocity: a polynomial about the lower end of its part of an octave of 1 + |v| / knee, whose
   leading bits are those of the octave and the part; beyond the table the network itself. */
#define TABLE(name, per_knee, end, halvings, half) \
    static real name(real v) \
    { \
        const real s = 1 + FABS(v) * per_knee; \
        bits leading; \
        if (!(s < end)) { \
            real torque; \
            name##_network(&v, &torque); \
            return torque; \
        } \
        memcpy(&leading, &s, sizeof s); \
        const int i = (int)(leading >> (DIGITS - halvings)) - (BIAS << halvings); \
        const real *c = name##_rows[v < 0 ? i + half : i], t = s - c[DEGREE + 1]; \
        real sum = c[DEGREE]; \
        for (int k = DEGREE - 1; k >= 0; k--) sum = c[k] + t * sum; \
        return sum; \
    }
