"""Fit the declared unknowns of a rig to its training logs.

examples:
  nnap-em identify bench --out fit
  nnap-em identify bench --out fit --smoother particle --particles 1000 --epochs 30
  nnap-em identify february --from fit --out fit2   its posterior is the prior of these logs

OUT gets model.npz, report.html, report.json, friction.csv (joint,velocity,torque,torque_std) and friction.png.
test/ serves for the reported prediction error only, never for the fit.  After Ctrl-C the same command goes on, with the
same numbers.  Exit status 3 where the fit does not describe the motion: the first sentence of the report gives the
reason.
"""

import argparse
import functools
import importlib
import math
import time
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float

from ..base.log import Log
from ..estimate.em.loop import EMState
from ..estimate.identify import MakeSmoother, Watch, identify
from ..estimate.known import identify_from
from ..estimate.store import MODEL_FILE
from ..machines.rig import Rig
from ..output.report.identification import write_identification
from .common import MISFIT_STATUS, prepared, resumable, write_models
from .main import SMOOTHERS


def run(args: argparse.Namespace, log: Log) -> int:
    """Fit, and report; the test logs serve for the reported error alone."""
    began = time.perf_counter()
    bench, start = prepared(args, MODEL_FILE, log)
    data, epochs = bench.train.data, []
    with resumable(args, bench, log):
        watch, key = _watch(bench.rig, args.epochs, epochs, log), jax.random.key(args.seed)
        options = {"key": key, "smoother": smoother(args), "epochs": args.epochs, "watch": watch}
        begin = identify if start is None else functools.partial(identify_from, start.fitted)
        fitted = begin(bench.rig, data, **options)
        settings = {"smoother": args.smoother, "particles": args.particles, "seed": args.seed}
        write_models(args, {MODEL_FILE: fitted}, data, settings=settings, epochs=epochs)
        described = write_identification(
            args.out, fitted, bench.train, bench.test, epochs,
            smoother=args.smoother, seed=args.seed, began=began, log=log,
        )  # fmt: skip
    return 0 if described else MISFIT_STATUS


def smoother(args: argparse.Namespace) -> MakeSmoother:
    """The chosen E-step."""
    options = {} if args.particles is None else {"num_particles": args.particles}
    home, _, name = SMOOTHERS[args.smoother].rpartition(".")
    return functools.partial(getattr(importlib.import_module(f"nnap_em.estimate.smoother.{home}"), name), **options)


def _watch(rig: Rig, most: int, epochs: list[dict[str, Any]], log: Log) -> Watch:
    last = time.perf_counter()

    def watch(state: EMState, seen: int, used: Bool[np.ndarray, " seq"]) -> None:
        nonlocal last
        moment, out = time.perf_counter(), np.flatnonzero(~np.asarray(used)).tolist()
        horizon, loglik, seconds = seen * rig.dt, float(state.loglik[-1]), moment - last
        last = moment
        epochs.append(
            {"epoch": state.epoch, "horizon_s": horizon, "log_likelihood": loglik, "left_out": out, "seconds": seconds}
        )
        sampled = f"  effective samples {state.ess:.0f}" if math.isfinite(state.ess) else ""
        log(
            f"epoch {state.epoch:3d} of {most}  horizon {horizon:.2f} {rig.time_unit}"
            f"  log-likelihood {loglik:.2f} nat per sequence"
            f"  noise std {_noise(rig, np.asarray(state.best.log_r))}{sampled}"
            f"  left out {len(out)} of {len(used)}  {seconds:.1f} s"
        )

    return watch


def _noise(rig: Rig, log_r: Float[np.ndarray, " obs"]) -> str:
    pairs = zip(rig.measured, np.exp(0.5 * log_r), strict=True)
    return ", ".join(f"{name} {std:.3g}" for name, std in pairs if name not in rig.noise_std) or "as declared"
