# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # A tour: a rig, a fit, a finding, a design
#
# A small slide carries an unknown load of friction, and a cable that nobody declared. From its logs we learn the
# friction, find the cable, and let the library propose the next experiment. It takes about two minutes.
#
# This notebook is kept as text. `make notebook` writes `examples/tour.ipynb`; `python examples/tour.py` runs it, too.

# %%
# %matplotlib inline
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import plant
from matplotlib.figure import Figure

import nnap_em
from nnap_em.explain.diagnosis.residual import names_of, residual
from nnap_em.output.report.fit_plots import error_figure, friction_figure

jax.config.update("jax_enable_x64", True)

# %% [markdown]
# ## A rig
#
# `plant.py` simulates machines and shares no code with the library. Its slide has a mass, a motor, friction, and here a
# cable that pulls like a spring of 30 N/m. Only the position is read, with 0.5 mm of noise.

# %%
cable = {"name": "torsional_spring", "joint": 1, "k": 30.0, "theta0": 0.05}
case = plant.Case(system="slide", effects=(cable,), noise=(5e-4, 5e-3), sequences=8, tests=3, steps=95, seed=1)
folder = Path("out/tour/rig")
plant.write(case, folder)
print((folder / "rig.toml").read_text())

# %% [markdown]
# `rig.toml` is what the owner of the machine declares: the mass, the motor, what is read. Friction is `unknown`, and
# there is no word of the cable.

# %%
rig = nnap_em.read_rig(folder / "rig.toml")
train, test = (nnap_em.read_logs(folder / part, rig) for part in ("train", "test"))
print(f"{len(train.files)} sequences to fit, {len(test.files)} to test, {train.data.t.shape[1]} rows each")

# %% [markdown]
# Can these logs identify what is asked? `check` fits nothing; it has a line for each question.

# %%
for line in nnap_em.check(rig, train, test, key=jax.random.key(0)):
    print(f"{line.mark:5s} {line.text}")

# %% [markdown]
# ## A fit
#
# Expectation-Maximisation learns the friction map and the noise. Velocities were never measured: they are smoothed.

# %%
fitted = nnap_em.identify(rig, train.data, key=jax.random.key(0))
names = names_of(fitted)
velocity = jnp.linspace(-0.8, 0.8, 81)[None]
friction_figure({"as declared": nnap_em.friction_table(fitted, velocity)}, names)

# %% [markdown]
# ## A finding
#
# `diagnose` fits, searches the catalogue of effects for what the declared physics lacks, adds it, and fits again.

# %%
diagnosis = nnap_em.diagnose(rig, train.data, key=jax.random.key(0))
found = nnap_em.findings(diagnosis)
for finding in found:
    print(finding.sentence)

# %% [markdown]
# The truth is 30 N/m about 0.05 m. This is the force that the declared model lacks, against the position:

# %%
left = residual(diagnosis.after, train.data)
figure = Figure(figsize=(5, 3), layout="constrained")
axes = figure.subplots()
axes.plot(left.state[..., 0].ravel(), left.partial_force[..., 0].ravel(), ".", color="#8A8A8A", ms=2)
x = np.linspace(*np.nanpercentile(left.state[..., 0], (1, 99)), 50)
axes.plot(x, -cable["k"] * (x - cable["theta0"]), "k--", label="true cable")
axes.set(xlabel="x [m]", ylabel="missing force [N]")
axes.legend()
figure  # noqa: B018

# %% [markdown]
# Does it predict better? Both models read half a second of each test sequence and foretell the rest.


# %%
def errors(model):
    """Root mean square errors by column and horizon."""
    prediction = nnap_em.predict(model, test.data, 0.4, key=jax.random.key(1))
    return nnap_em.horizon_errors(prediction, model, test.data, 0.4, horizons)


horizons = (0.1, 0.2, 0.4, 0.5)
error = {"horizons_s": horizons, "before": errors(diagnosis.before), "after": errors(diagnosis.after)}
error_figure(error, names)

# %% [markdown]
# ## A design
#
# Which inputs should the machine play next, so that its friction near rest is known better?

# %%
design = nnap_em.design(diagnosis.after, train.data, key=jax.random.key(2), seconds=4.0, sequences=2)
figure = Figure(figsize=(5, 3), layout="constrained")
axes = figure.subplots()
for u in design.u[..., 0]:
    axes.step(design.t, u, where="post")
axes.set(xlabel="time [s]", ylabel="force to be played [N]")
figure  # noqa: B018
