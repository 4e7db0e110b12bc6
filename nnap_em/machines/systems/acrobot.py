"""The acrobot: a two-link arm whose second joint is driven; of the pendubot it is the first."""

from .arm import TwoLinkArm

Acrobot = TwoLinkArm
drives = (2,)

table_i = {
    "m1": 0.235,
    "m2": 0.25,
    "l1": 0.275,
    "l2": 0.285,
    "lc1": 0.1375,
    "lc2": 0.1425,
    "I1": 0.235 * 0.275**2 / 12,
    "I2": 0.25 * 0.285**2 / 12,
    "g": 9.81,
}
"""The paper's Table I; links taken as uniform rods (lc = l / 2, I = m l^2 / 12), as the data of the interface do."""
