"""Choice of the simplest shape that explains a learned curve, compared in the basis of the curve."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from ...model.effects.base import Curve
from .forms import Description, Form, Place, Places, Quantity, Size, View, forms

EXPLAINS, INDISTINGUISHABLE = 0.85, 2.0
"""Least share of the variance, adjusted for free numbers, that a named shape explains: a sine has 81 % of a square; and
largest difference in the Schwarz criterion that is no evidence, so the simpler shape wins [Kass & Raftery 1995]."""


class Shape(NamedTuple):
    """The simplest shape that explains a curve."""

    kind: str
    numbers: dict[str, Quantity]
    explains: float
    """Share of the variance of the curve, weighted by how well it is known."""
    resolution: float
    """Distance of the basis functions, in units of the signal: no narrower transition, bump or dip can be seen."""
    known: tuple[float, float]
    """The range of the signal in which the curve is known; of an angle it may pass the end of the turn."""
    rivals: tuple[str, ...]
    """Shapes of no more numbers that explain it as well."""
    words: str

    def entry(self) -> dict[str, Any]:
        """The entry `shape` of `report.json`."""
        numbers = {name: number._asdict() for name, number in self.numbers.items()}
        return {"kind": self.kind, "numbers": numbers} | {n: getattr(self, n) for n in Shape._fields[2:-1]}


class _Fit(NamedTuple):
    """A form at its best."""

    criterion: float
    price: int
    explains: float
    shape: Description


def shape(curve: Curve) -> Shape:
    """The simplest shape that explains a learned curve, with numbers and units; a smooth function where none does.
    Every shape is seen through the basis of the curve, so that a sharp step and the transition that the basis makes of
    it are one. Places and widths from a grid, polished, sizes by linear least squares [Golub & Pereyra 1973]; of the
    shapes the first, in the order of simplicity, whose Schwarz criterion is not clearly above the lowest.
    """
    view = _view(curve)
    fits = _fits(view) if view.clear else []
    lowest = min((fit.criterion for fit in fits), default=0.0)
    even = [fit for fit in fits if fit.criterion < lowest + INDISTINGUISHABLE]
    (_, price, explains, chosen), *others = even or [_Fit(lowest, 0, 0.0, _smooth(view))]
    rivals = tuple(dict.fromkeys(f.shape.kind for f in others if f.shape.kind != chosen.kind and f.price <= price))
    seen, words = view.known.mean(), chosen.words
    words += f", seen on {100 * seen:.0f} % of the range of {curve.signal}" if seen <= 0.9 else ""
    words += f" (a {' or '.join(rivals)} would explain it as well)" if rivals else ""
    limits = float(view.x.min()), float(view.x.max())
    return Shape(chosen.kind, chosen.numbers, explains, view.fine, limits, rivals, words)


def _view(curve: Curve) -> View:
    """The nodes at which the curve is better known than it is large, or all where these are less than a quarter; an
    angle is cut at the end of the widest unknown gap.
    """
    weight = 1 / np.maximum(curve.std, 1e-3 * np.ptp(curve.mean) + 1e-300) ** 2
    level = np.average(curve.mean, weights=weight)
    rms = np.sqrt(np.average((curve.mean - level) ** 2, weights=weight))
    known = curve.std < 0.5 * rms  # largest standard deviation, in rms of the curve, at which the curve counts as known
    clear = bool(known.mean() > 0.25)
    known |= not clear
    x, length = curve.x[known], float(np.ptp(curve.x))
    whole = curve.turns and bool(known.mean() > 0.9)
    if curve.turns and not whole:
        inside = np.sort(x)
        cut = inside[(int(np.argmax(np.diff(inside, append=inside[0] + length))) + 1) % inside.size]
        x = cut + (x - cut) % length
    count = curve.x.size if curve.basis is None else curve.basis.shape[1]
    return View(curve, known, clear, x, whole, length / (count - (not curve.turns)))


def _fits(view: View) -> list[_Fit]:
    """The forms that explain the curve, the simplest first."""
    (target, project), out = _seen(view), []
    total, n = float(target @ target), len(target)
    for form in sorted(forms(view), key=lambda form: form.price):
        if n - form.price >= 2:
            place, size, rss = _best(form, target, project, view)
            explains = 1 - rss / total
            if 1 - (1 - explains) * n / (n - form.price) >= EXPLAINS:
                criterion = (n + 1) * np.log(rss + view.x.size) + form.price * np.log(n + 1)  # an error at every node
                out.append(_Fit(criterion, form.price, explains, form.describe(view, place, size)))
    return out


def _seen(view: View) -> tuple[Float[np.ndarray, " direction"], Float[np.ndarray, "direction known"]]:
    """The curve as its basis shows it, every orthonormal direction in units of its error, the constant taken out; and
    the matrix that makes it of values.
    """
    curve, y = view.curve, view.curve.mean[view.known]
    floor = 0.05  # smallest difference that counts, in rms of the curve: curves bend with all else that the model lacks
    root = 1 / np.hypot(curve.std[view.known], floor * np.std(y))
    basis = root[:, None] * (np.eye(y.size) if curve.basis is None else curve.basis[view.known])
    one = root / np.linalg.norm(root)
    left, size, _ = np.linalg.svd(basis - one[:, None] * (one @ basis))
    project = left[:, : size.size].T[size > 1e-3 * size[0]] * root
    return project @ y, project


def _best(
    form: Form, target: Float[np.ndarray, " direction"], project: Float[np.ndarray, "direction known"], view: View
) -> tuple[Place, Size, float]:
    """Place, size and squared residual of the best member of a form: the best two of its grid, polished."""

    def fit(places: Places) -> tuple[Float[np.ndarray, "place column"], Float[np.ndarray, "place direction"]]:
        seen = project @ form.columns(view, places)
        size = np.linalg.pinv(seen, rcond=1e-3) @ target
        return size, target - (seen @ size[..., None])[..., 0]

    def polished(start: Place) -> Place:
        def moved(part: Place) -> Place:
            return np.append(start[: form.fixed], part)

        bounds = (
            form.grid.min(axis=0)[form.fixed :],
            form.grid.max(axis=0)[form.fixed :] + 1e-9,
        )  # a grid may be one place
        best = least_squares(lambda part: fit(moved(part)[None])[1][0], start[form.fixed :], bounds=bounds, max_nfev=15)
        return moved(best.x)

    best = form.grid[np.argsort(np.sum(fit(form.grid)[1] ** 2, axis=1), kind="stable")[:2]]
    best = np.stack([*map(polished, best)]) if form.fixed < best.shape[1] else best
    size, left = fit(best)
    rss = np.sum(left**2, axis=1)
    first = int(np.argmin(rss))
    return best[first], size[first], float(rss[first])


def _smooth(view: View) -> Description:
    """A curve that no shape explains: the place and the size of its largest value."""
    x, y = view.curve.x[view.known], view.curve.mean[view.known]
    at, tall = view.along(x[int(np.argmax(y))]), view.force(np.ptp(y))
    words = f"a smooth function of {view.curve.signal}, largest at {at}, {tall} from trough to peak"
    return Description("smooth", {"largest_at": at, "height": tall}, words)
