"""Laws in the place of one another, over the whole length of the logs."""

import jax
import numpy as np
import pytest

from nnap_em.commands import cli
from nnap_em.data.logs import read_logs
from nnap_em.data.rig import read_rig
from nnap_em.diagnosis.rivals import proposals_for, with_rival
from nnap_em.em.loop import e_step
from nnap_em.fit.identify import identify
from nnap_em.systems import specs

GAIN = 0.7


@pytest.fixture(scope="module")
def weak_drive(tmp_path_factory):
    """A slide whose drive gives less than the logs say, fitted without and with that gain."""
    folder = tmp_path_factory.mktemp("rivals") / "slide"
    size = ("--system", "slide", "--sequences", "4", "--test", "0", "--steps", "150")
    assert cli.main(["simulate", str(folder), *size]) == 0
    rig = read_rig(folder / "rig.toml", specs)
    logged = read_logs(folder / "train", rig).data
    data = logged._replace(u=np.asarray(logged.u) / GAIN)
    bare = identify(rig, data, key=jax.random.key(0), epochs=12)
    full = with_rival(bare, data, None, lambda effect: effect.name == "motor_gain")
    assert full is not None
    return data, bare, full


def test_a_law_on_top_is_fitted_near_the_truth(weak_drive):
    data, bare, full = weak_drive
    (effect,) = full.model.effects
    assert abs(float(effect.values()["gain"]) - GAIN) < 0.05
    assert with_rival(bare, data, None, lambda effect: effect.name == "base_tilt") is None  # a slide has no such law
    assert "motor_gain" in {effect.name for effect in proposals_for(bare, data)}


def test_a_rival_has_the_rule_and_the_precision_of_the_whole_length(weak_drive):
    """Passes have the rule of short horizons: what is stated afterwards is not under it."""
    data, bare, full = weak_drive
    for field in ("ratio_precision", "symmetry_std"):
        assert float(getattr(full.m_step, field)) == float(getattr(bare.m_step, field))
    weights = full.m_step.weights(full.model)
    early = full.m_step.while_growing().weights(full.model)
    stated, brief = (np.asarray(w.prior_precision(full.model.unknown)) for w in (weights, early))
    assert np.trace(stated) < np.trace(brief)  # looser
    _, info = full.m_step(full.model, e_step(full.model, data, full.smoother, key=full.state.key), data)
    nodes = slice(weights.nodes.size)
    diagonal = np.diag(full.state.hessian)[nodes] / np.diag(info.hessian)[nodes]
    assert np.median(np.abs(np.log(diagonal))) < 0.1
