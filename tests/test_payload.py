"""A load of unknown mass and centre on a machine from a file, found in logs of a motion in closed form."""

import jax
import pytest
import rod

from nnap_em import diagnose, findings
from nnap_em.effects import catalogue

MASS, PLACE = 0.5, (0.15, -0.3)
"""Mass of the load [kg], and its place in the plane of motion [m]."""


@pytest.mark.slow  # fast: test_played.py, a payload
def test_mass_and_centre_of_a_load_on_one_joint_are_found(tmp_path):
    """Weight and inertia of a hinge give mass and centre in the plane of its motion; along the axis nothing is seen."""
    data = rod.logs(0, mass=MASS, at=PLACE)
    diagnosis = diagnose(rod.rig(tmp_path), data, key=jax.random.key(0))
    (finding,) = findings(diagnosis)
    assert finding.effect.name == "payload" and finding.effect.joint == 1
    estimates = finding.parameters
    for name, truth, within in (("mass", MASS, 0.1 * MASS), ("centre_x", PLACE[0], 0.02), ("centre_z", PLACE[1], 0.02)):
        assert estimates[name].value == pytest.approx(truth, abs=within)
        assert abs(estimates[name].value - truth) < 4 * estimates[name].std < 4 * within
    assert estimates["centre_y"].std > 0.2  # nobody knows
    assert estimates.keys() == catalogue["payload"].units.keys()
