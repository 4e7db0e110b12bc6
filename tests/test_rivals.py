"""Laws in the place of one another, over the whole length of the logs."""

import jax
import numpy as np
import pytest

from nnap_em.commands import cli
from nnap_em.data.logs import read_logs
from nnap_em.data.rig import read_rig
from nnap_em.diagnose import rivals
from nnap_em.diagnose.hypothesis import Found
from nnap_em.diagnose.keys import key_of
from nnap_em.diagnose.outcome import Closed
from nnap_em.diagnose.rivals import compare_equivalents, instead, possible
from nnap_em.diagnose.verdict import EQUIVALENT_NATS, PRICE
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
    full = instead(bare, data, None, lambda effect: effect.name == "motor_gain")
    assert full is not None
    return data, bare, full


def _closed(bare, full, *equivalent) -> Closed:
    return Closed(bare, full, (Found(1.0, 1.0, 0.0, equivalent),), ())


def test_a_law_on_top_is_fitted_near_the_truth(weak_drive):
    data, bare, full = weak_drive
    (effect,) = full.model.effects
    assert abs(float(effect.values()["gain"]) - GAIN) < 0.05
    assert instead(bare, data, None, lambda effect: effect.name == "base_tilt") is None  # a slide has no such law
    assert "motor_gain" in {effect.name for effect in possible(bare, data)}


def test_a_law_pays_for_its_number(weak_drive):
    _, bare, full = weak_drive
    assert [np.sum(fit.state.top) - rivals._total(fit) for fit in (bare, full)] == pytest.approx([0.0, PRICE])


def test_only_what_the_whole_length_cannot_tell_stays_equivalent(weak_drive):
    data, bare, full = weak_drive
    (law,) = map(key_of, full.model.effects)
    delay = next(key_of(effect) for effect in possible(bare, data) if effect.name == "input_delay")
    compared = compare_equivalents(_closed(bare, full, delay, law), data)
    assert compared.found[0].equivalent == (law,)  # the same law in its own place is as likely
    untouched = _closed(bare, full)
    assert compare_equivalents(untouched, data) is untouched


def test_a_rival_that_is_clearly_likelier_takes_the_place(weak_drive):
    """A delay that the search had named where the drive is weak."""
    data, bare, full = weak_drive
    delay = instead(bare, data, None, lambda effect: effect.name == "input_delay")
    (gain,) = map(key_of, full.model.effects)
    compared = compare_equivalents(_closed(bare, delay, gain), data)
    (effect,) = compared.after.model.effects
    assert effect.name == "motor_gain" and abs(float(effect.values()["gain"]) - GAIN) < 0.05
    assert compared.found[0].gain > 1.0 + EQUIVALENT_NATS  # the lead over the law that it replaces is added
    assert compared.found[0].equivalent == ()
