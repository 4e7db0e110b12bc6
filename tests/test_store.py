"""A stored model: the same numbers to the last bit, or refused with the reason."""

import json
import shutil
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nnap_em.errors import StoreError
from nnap_em.estimate.identify import Identified, begin
from nnap_em.estimate.smoother.gaussian import CubatureSmoother
from nnap_em.estimate.smoother.particle import ExactBackward, Guided, ParticleSmoother
from nnap_em.estimate.store import fingerprint, load, read, save
from nnap_em.logs.dataset import Dataset
from nnap_em.machines.rig import Declared, Rig

ARM = {
    name: Declared(value, 0.1 * value)
    for name, value in {"m1": 0.2, "m2": 0.3, "l1": 0.3, "l2": 0.3, "lc1": 0.15, "lc2": 0.1, "I1": 0.01}.items()
} | {"I2": Declared(0.01, 0.0), "g": Declared(9.81, 0.0)}
RIGS = {
    "arm": Rig(
        "ärm", "acrobot", ARM, True, ("u",), (2,), 0.01, "session", ("theta1",), {}, {"theta2": Declared(0.1, 0.5)}
    ),
    "slide": Rig(
        "free", "slide", {"m": Declared(1.0, 0.2)}, False, ("f",), (1,), 0.02, "sequence", ("dx", "x"), {"x": 0.1}, {}
    ),
}


def _data(rig: Rig, rows: int = 40) -> Dataset:
    t = rig.dt * np.arange(rows)
    y = np.sin(3 * t)[None, :, None] + np.arange(len(rig.measured))
    return Dataset(t[None], 0.1 * np.cos(t)[None, :, None], y, np.ones((1, rows), bool))


def _fitted(name: str = "arm") -> Identified:
    """A model with other numbers than any that `begin` makes, some of them awkward."""
    rig, rng = RIGS[name], np.random.default_rng(0)
    fitted = begin(rig, _data(rig), key=jax.random.key(5))

    def stir(leaf):
        return leaf * rng.uniform(0.5, 1.5, leaf.shape) if eqx.is_inexact_array(leaf) else leaf

    model = jax.tree.map(stir, fitted.state.model)
    model = eqx.tree_at(lambda m: m.log_r, model, model.log_r.at[0].set(5e-324))
    state = fitted.state._replace(
        epoch=7, model=model, key=jax.random.key(2**40), loglik=np.array([-np.inf, np.nan, 0.1])
    )
    return fitted._replace(state=state)


def _bits(fitted: Identified) -> list:
    def one(leaf):
        if isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            leaf = jax.random.key_data(leaf)
        if isinstance(leaf, jax.Array | np.ndarray):
            return type(leaf), str(leaf.dtype), leaf.shape, np.asarray(leaf).tobytes()
        return repr(leaf)

    return [one(leaf) for leaf in jax.tree.leaves(tuple(fitted)[1:])]


@pytest.fixture(scope="module")
def stored(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("stored") / "model.npz"
    save(path, _fitted())
    return path


@pytest.fixture
def file(tmp_path, stored) -> Path:
    return Path(shutil.copy(stored, tmp_path))


@pytest.mark.parametrize("name", RIGS)
def test_a_stored_model_comes_back_to_the_last_bit(tmp_path, name):
    fitted = _fitted(name)
    notes = {"epochs": [{"seconds": 1.5, "left_out": [3]}]}
    save(tmp_path / "new" / "model.npz", fitted, fingerprint="abc", notes=notes)
    stored = read(tmp_path / "new" / "model.npz")
    assert _bits(stored.fitted) == _bits(fitted)
    assert jax.tree.structure(tuple(stored.fitted)[1:]) == jax.tree.structure(tuple(fitted)[1:])
    assert stored.fitted.rig == fitted.rig
    assert (stored.fingerprint, stored.notes) == ("abc", notes)
    v = jnp.linspace(-3.0, 3.0, len(fitted.model.log_q) // 2)
    np.testing.assert_array_equal(stored.fitted.model.unknown(v), fitted.model.unknown(v))


@pytest.mark.parametrize("windows", [True, False])
def test_a_stored_model_keeps_its_smoother(tmp_path, windows):
    """Its path may be a string."""

    def make(bank):
        if windows:
            return CubatureSmoother(bank, window=30, inflations=(1.0, 2.0))
        start = CubatureSmoother(bank, iterations=2)
        return ParticleSmoother(start, Guided(), ExactBackward(7), num_particles=31, dtype=float)

    fitted = begin(RIGS["slide"], _data(RIGS["slide"]), key=jax.random.key(5), smoother=make)
    save(f"{tmp_path}/model.npz", fitted)
    loaded = load(f"{tmp_path}/model.npz")
    assert _bits(loaded) == _bits(fitted)
    assert jax.tree.structure(loaded.smoother) == jax.tree.structure(fitted.smoother)  # statics, too


def test_settings_of_the_fit_are_kept_and_the_same_model_makes_the_same_file(tmp_path):
    fitted = _fitted("slide")
    rule = eqx.tree_at(lambda m: m.ridge, fitted.m_step, 0.25)
    rule = eqx.tree_at(lambda m: m.prior.mean, rule, jnp.zeros(0))
    object.__setattr__(rule, "nodes", 31)  # static
    save(tmp_path / "m.npz", fitted._replace(m_step=rule))
    loaded = load(tmp_path / "m.npz")
    assert (loaded.m_step.nodes, loaded.m_step.ridge) == (31, 0.25)
    save(tmp_path / "again.npz", loaded)
    assert (tmp_path / "again.npz").read_bytes() == (tmp_path / "m.npz").read_bytes()


FOREIGN = {
    "cut short": (lambda path, whole: path.write_bytes(whole[: len(whole) // 3]), "no model, or damaged or cut short"),
    "npz": (lambda path, _: np.savez(path, x=np.zeros(3)), "no model"),
    "other header": (lambda path, _: np.savez(path, header=np.frombuffer(b'{"kind": "a"}', np.uint8)), "another pro"),
    "absent": (lambda path, _: None, "cannot be read"),
}


def test_a_foreign_file_is_refused(tmp_path, stored):
    for name, (make, reason) in FOREIGN.items():
        path = tmp_path / name / "foreign.npz"
        path.parent.mkdir()
        make(path, stored.read_bytes())
        with pytest.raises(StoreError, match=rf"foreign\.npz: .*{reason}.*; give the model\.npz"):
            load(path)


def _node(header, *place: str) -> dict:
    """Parts of a node of the fit."""
    form = header["fit"]
    for name in place:
        form = form[1][name]
    return form[1]


def _smoother(header, kind: str) -> None:
    header["fit"][1]["smoother"][0] = kind


OTHER_FORM = "StateSpaceModel at state/model is not loaded, or of another structure"
OTHER_VERSIONS = [
    (
        lambda header, _: header.update(format=4, version="0.1"),
        r"format 4 \(nnap_em 0\.1\), this version reads format 5",
    ),
    (lambda header, _: header.update(format=6), "format 6"),
    (lambda header, _: _node(header, "rig")["system"].update(of="crane"), "'crane' is not registered"),
    (lambda header, _: header.pop("notes"), "'notes'"),
    (lambda header, _: _node(header, "rig").pop("dt"), "rig is not loaded, or of another structure"),
    (lambda header, arrays: arrays.pop("/state/model/log_q"), "state/model/log_q"),
    (lambda header, _: _node(header, "state", "model").pop("log_q"), OTHER_FORM),
    (lambda header, _: _node(header, "state", "model").update(extra={"is": "plain", "of": 0}), OTHER_FORM),
    (
        lambda header, _: _smoother(header, "away:OnePass"),
        "away:OnePass at smoother is not loaded.*; first import what adds its parts",
    ),
    (lambda header, _: _smoother(header, "os:mkdir"), "os:mkdir at smoother is not loaded"),
    (lambda header, _: _node(header, "state", "model", "unknown", "mlp")["activation"].update(of="relu"), "'relu'"),
]


def test_a_file_of_another_version_is_refused(file):
    with np.load(file) as content:
        whole = {name: content[name] for name in content.files}
    for change, reason in OTHER_VERSIONS:
        arrays = dict(whole)
        header = json.loads(arrays.pop("header").tobytes())
        change(header, arrays)
        np.savez(file, header=np.frombuffer(json.dumps(header).encode(), np.uint8), **arrays)
        with pytest.raises(StoreError, match=rf"model\.npz: .*{reason}.*(identify again|registered are)"):
            load(file)


def test_64_bits_are_not_rounded(file):
    with jax.enable_x64(False), pytest.raises(StoreError, match="64 bits; first call jax"):
        load(file)


def test_the_fingerprint_tells_data_apart():
    data = _data(RIGS["slide"])
    same = Dataset(*(np.array(part) for part in data))
    other = data._replace(y=np.nextafter(data.y, 9.0))
    shorter = data._replace(valid=data.valid & (np.arange(40) < 39))
    assert fingerprint(data) == fingerprint(same)
    assert len({fingerprint(d) for d in (data, other, shorter)}) == 3
