"""The loop end to end: what is there is found and sized, where nothing is nothing is said."""

import jax
import jax.numpy as jnp
import pytest
from helpers import compiled
from rigs import slide_logs, slide_rig

from nnap_em import diagnose, findings
from nnap_em.diagnosis import search
from nnap_em.diagnosis.findings import Finding, verdict
from nnap_em.effects import catalogue
from nnap_em.effects.position import TorsionalSpring

SPRING = TorsionalSpring.of(20.0, 1.0, 0.0, 0.0, joint=1)
DRAG = catalogue["air_drag"](jnp.asarray(0.8), joint=1)


def test_a_spring_is_named_and_sized_and_other_recordings_compile_nothing(monkeypatch):
    """The drag of the joint's own velocity is a static map: the learned friction holds it, and it is not missing."""
    sought = []
    monkeypatch.setattr(search, "interventions", lambda *_: sought.append(True) or ())
    diagnosis = diagnose(slide_rig(), slide_logs(0, laws=(SPRING, DRAG), sequences=6), key=jax.random.key(0))
    found = findings(diagnosis)
    assert [finding.effect.name for finding in found] == ["torsional_spring"] and not sought  # in white noise
    k = found[0].parameters["k"]
    assert k.unit == "N/m" and k.value == pytest.approx(20.0, rel=0.05) and abs(k.value - 20.0) < 3 * k.std
    assert diagnosis.complete and [step.accepted is None for step in diagnosis.steps] == [False, True]
    other = slide_logs(1, laws=(DRAG,), sequences=3, steps=92)
    with compiled() as programs:
        diagnosis = diagnose(slide_rig(), other, key=jax.random.key(0))
    assert not findings(diagnosis) and diagnosis.after is diagnosis.before
    assert programs == []


CLAIMS = {  # errors before and after by channel, and what is said of them
    "do not trust": {"theta1": (0.2, 0.3)},
    "falls from 0.2 to 0.1 and that of theta2 rises from 0.3 to 0.4": {"theta1": (0.2, 0.1), "theta2": (0.3, 0.4)},
    "of theta2 does not fall with it (0.1 before, 0.2 after)": {"theta1": (0.2, 0.19), "theta2": (0.1, 0.2)},
}


@pytest.mark.parametrize("claim", CLAIMS)
def test_the_verdict_claims_a_fall_only_where_there_is_one(claim):
    laws = [Finding(catalogue["payload"](jnp.zeros(()), joint=2), {}, {}, (), "payload")]
    before, after = ({name: [pair[side]] for name, pair in CLAIMS[claim].items()} for side in (0, 1))
    error = {"horizons_s": [1.0], "before": before, "after": after}
    assert claim in verdict(laws, error) and "0.5 s prediction error" in verdict(laws, error | {"reach_s": 0.5})
