"""Choice of the simplest shape that explains a learned curve, compared in the basis of the curve."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from ..effects.base import Curve
from .forms import Description, Form, Quantity, View, forms

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


class _Seen(NamedTuple):
    """The curve as its basis shows it, every direction in units of its error, the constant taken out."""

    target: Float[np.ndarray, " direction"]
    project: Float[np.ndarray, "direction node"]

    def fit(
        self, columns: Float[np.ndarray, "place node column"]
    ) -> tuple[Float[np.ndarray, "place column"], Float[np.ndarray, "place direction"]]:
        """Sizes of the columns by linear least squares, and the remainder, for each of many places."""
        seen = self.project @ columns
        gram, way = seen.swapaxes(1, 2) @ seen, seen.swapaxes(1, 2) @ self.target[:, None]
        ridge = (1e-6 * np.trace(gram, axis1=1, axis2=2) + 1e-300)[:, None, None] * np.eye(gram.shape[1])
        size = np.linalg.solve(gram + ridge, way)
        return size[..., 0], self.target - (seen @ size)[..., 0]


def shape(curve: Curve) -> Shape:
    """The simplest shape that explains a learned curve, with numbers and units; a smooth function where none does.
    Every shape is seen through the basis of the curve, so that a sharp step and the transition that the basis makes of
    it are one. Places and widths from a grid, polished, sizes by linear least squares [Golub & Pereyra 1973]; of the
    shapes the first, in the order of simplicity, whose Schwarz criterion is not clearly above the lowest.
    """
    known = _known(curve)
    if known is None:
        return _smooth(curve, np.ones(curve.x.shape, bool))
    view, seen = _view(curve, known), _seen(curve, known)
    total, n = float(seen.target @ seen.target), len(seen.target)
    tried: list[tuple[float, int, float, Description]] = []
    for form in sorted(forms(view), key=lambda form: form.price):
        if n - form.price < 2:
            continue
        place, size, rss = _best(form, seen, view)
        explains = 1 - rss / total
        if 1 - (1 - explains) * n / (n - form.price) >= EXPLAINS:
            criterion = (n + 1) * np.log(rss + known.sum()) + form.price * np.log(n + 1)  # an error at every node
            tried.append((criterion, form.price, explains, form.describe(view, place, size)))
    if not tried:
        return _smooth(curve, known)
    lowest = min(criterion for criterion, *_ in tried)
    (_, price, explains, chosen), *others = [one for one in tried if one[0] < lowest + INDISTINGUISHABLE]
    rivals = tuple(dict.fromkeys(t.kind for _, p, _, t in others if t.kind != chosen.kind and p <= price))
    words = chosen.words + _looked(curve, known)
    words += f" (a {' or '.join(rivals)} would explain it as well)" if rivals else ""
    limits = view.low + view.length * view.start, view.low + view.length * (view.start + view.span)
    return Shape(chosen.kind, chosen.numbers, explains, view.fine * view.length, limits, rivals, words)


def _known(curve: Curve) -> np.ndarray | None:
    """Nodes at which the curve is better known than it is large; None where these are less than a quarter."""
    weight = 1 / np.maximum(curve.std, 1e-3 * np.ptp(curve.mean) + 1e-300) ** 2
    level = np.average(curve.mean, weights=weight)
    rms = np.sqrt(np.average((curve.mean - level) ** 2, weights=weight))
    known = curve.std < 0.5 * rms  # largest standard deviation, in rms of the curve, at which the curve counts as known
    return known if rms > 0 and known.mean() > 0.25 else None


def _view(curve: Curve, known: np.ndarray) -> View:
    """The axis of the curve; an angle is cut at the end of the widest unknown gap."""
    low, length = float(curve.x[0]), float(np.ptp(curve.x))
    z = (curve.x - low) / length
    whole = curve.turns and bool(known.mean() > 0.9)
    if curve.turns and not whole:
        inside = np.sort(z[known])
        gaps = np.diff(inside, append=inside[0] + 1)
        cut = inside[(int(np.argmax(gaps)) + 1) % inside.size]
        z = cut + (z - cut) % 1.0
    start, end = float(z[known].min()), float(z[known].max())
    across = curve.signal, curve.signal_unit, curve.unit
    return View(*across, low, length, curve.turns, whole, start, end - start, _fine(curve), z[known])


def _seen(curve: Curve, known: np.ndarray) -> _Seen:
    """Orthonormal directions that the basis has where the curve is known, in units of its error there."""
    y = curve.mean[known]
    floor = 0.05  # smallest difference that counts, in rms of the curve: curves bend with all else that the model lacks
    root = 1 / np.hypot(curve.std[known], floor * np.std(y))
    basis = np.eye(y.size) if curve.basis is None else curve.basis[known]
    one = root / np.linalg.norm(root)
    left, size, _ = np.linalg.svd(root[:, None] * basis - one[:, None] * (one @ (root[:, None] * basis)))
    project = left[:, : size.size].T[size > 1e-3 * size[0]] * root
    return _Seen(project @ y, project)


def _best(form: Form, seen: _Seen, view: View) -> tuple[np.ndarray, np.ndarray, float]:
    """Place, size and squared residual of the best member of a form: the best two of its grid, polished."""

    def left(place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        size, residual = seen.fit(form.columns(view, place[None]))
        return size[0], residual[0]

    def polished(start: np.ndarray) -> np.ndarray:
        def moved(part: np.ndarray) -> np.ndarray:
            place = start.copy()
            place[free] = part
            return place

        bounds = low[free], high[free]
        return moved(least_squares(lambda part: left(moved(part))[1], start[free], bounds=bounds, max_nfev=15).x)

    _, residual = seen.fit(form.columns(view, form.grid))
    rss, low, high = (residual**2).sum(axis=1), form.grid.min(axis=0), form.grid.max(axis=0)
    far = rss.min() > 0.5 * seen.target @ seen.target  # from an explanation
    free = [i for i in form.free if low[i] < high[i] and not far]
    places = [form.grid[i] for i in np.argsort(rss, kind="stable")[: 2 if free else 1]]
    fits = [(place, *left(place)) for place in (map(polished, places) if free else places)]
    place, size, residual = min(fits, key=lambda fit: float(fit[2] @ fit[2]))
    return place, size, float(residual @ residual)


def _smooth(curve: Curve, known: np.ndarray) -> Shape:
    """A curve that no shape explains: the place and the size of its largest value."""
    x, y = curve.x[known], curve.mean[known]
    at, tall = Quantity(float(x[int(np.argmax(y))]), curve.signal_unit), Quantity(float(np.ptp(y)), curve.unit)
    words = f"a smooth function of {curve.signal}, largest at {at}, {tall} from trough to peak"
    numbers = {"largest_at": at, "height": tall}
    fine, limits = _fine(curve) * float(np.ptp(curve.x)), (float(x[0]), float(x[-1]))
    return Shape("smooth", numbers, 0.0, fine, limits, (), words + _looked(curve, known))


def _fine(curve: Curve) -> float:
    """Distance of the basis functions, as a share of the axis."""
    count = curve.x.size if curve.basis is None else curve.basis.shape[1]
    return 1 / (count - (not curve.turns))


def _looked(curve: Curve, known: np.ndarray) -> str:
    """Words for the known share of the range, unless it is nearly all of it."""
    share = known.mean()
    return "" if share > 0.9 else f", seen on {100 * share:.0f} % of the range of {curve.signal}"
