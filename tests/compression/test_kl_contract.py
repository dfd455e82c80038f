"""What holds for every reading: the estimator contract, saving and loading."""

import inspect
import json

import numpy as np
import pytest

from loopclosure import store
from loopclosure.compression import READINGS, ChannelKL, FlatKL, SequenceKL
from loopclosure.errors import ConfigError, FitError, ModelError

MAPS = np.random.default_rng(0).normal(size=(20, 4, 3, 6)).astype(np.float32)
every_reading = pytest.mark.parametrize("kind", READINGS.values(), ids=READINGS)


@every_reading
def test_the_constructor_only_stores(kind):
    arguments = dict.fromkeys(inspect.signature(kind).parameters, object())
    kl = kind(**arguments)
    assert vars(kl) == arguments
    assert kl.settings() == arguments


@every_reading
def test_unfitted_is_refused(kind):
    kl = kind(gamma=0.5)
    calls = {
        "transform": lambda: kl.transform(MAPS),
        "to_arrays": kl.to_arrays,
        "inverse": lambda: kl.inverse_transform(
            *{"channel": [MAPS], "flat": [MAPS[:, 0, 0]], "sequence": [MAPS, np.eye(20)]}[kind.reading]
        ),
    }
    for call in calls.values():
        with pytest.raises(FitError, match="before it was fitted"):
            call()


@pytest.mark.parametrize("name", ["basis_", "energies_", "energy_kept_", "n_components_"])
@pytest.mark.parametrize("kind", [ChannelKL, FlatKL])
def test_unfitted_has_no_attributes(kind, name):
    with pytest.raises(FitError, match="before it was fitted"):
        getattr(kind(gamma=0.5), name)


@every_reading
def test_fit_returns_itself_and_transform_is_repeatable(kind):
    kl = kind(gamma=0.5)
    assert kl.fit(MAPS) is kl
    np.testing.assert_array_equal(kl.transform(MAPS), kl.transform(MAPS))
    np.testing.assert_array_equal(kl.transform(MAPS), kind(gamma=0.5).fit(MAPS).transform(MAPS))


@every_reading
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_maps_that_are_not_finite_are_refused(kind, bad):
    maps = MAPS.copy()
    maps[3, 1, 2, 4] = bad
    with pytest.raises(FitError, match="NaN"):
        kind(gamma=0.5).fit(maps)
    with pytest.raises(FitError, match="NaN"):
        kind(gamma=0.5).fit(MAPS).transform(maps)


@pytest.mark.parametrize("kind", [ChannelKL, FlatKL])
def test_a_refused_batch_leaves_a_stream_as_it_was(kind):
    kl = kind(gamma=0.5).fit(MAPS)
    before = kl.transform(MAPS)
    with pytest.raises(FitError):
        kl.partial_fit(np.full_like(MAPS, np.nan))
    np.testing.assert_array_equal(kl.transform(MAPS), before)


@every_reading
@pytest.mark.parametrize("rule", [{}, {"gamma": 1.5}, {"gamma": 0.5, "components": 2}])
def test_a_bad_rule_is_refused_by_fit(kind, rule):
    with pytest.raises(ConfigError):
        kind(**rule).fit(MAPS)


@every_reading
@pytest.mark.parametrize("rule", [{"gamma": 0.5}, {"energy": 0.8, "whiten": True}, {"components": 3}])
def test_save_and_load(kind, rule, tmp_path):
    kl = kind(**rule).fit(MAPS)
    kl.save(tmp_path)
    loaded = kind.load(tmp_path)
    assert loaded.settings() == kl.settings()
    np.testing.assert_array_equal(loaded.transform(MAPS), kl.transform(MAPS))


@pytest.mark.parametrize("kind", [ChannelKL, FlatKL])
def test_a_loaded_stream_goes_on(kind, tmp_path):
    whole = kind(components=4).partial_fit(MAPS[:9])
    whole.save(tmp_path)
    loaded = kind.load(tmp_path).partial_fit(MAPS[9:])
    whole.partial_fit(MAPS[9:])
    np.testing.assert_array_equal(loaded.transform(MAPS), whole.transform(MAPS))
    assert loaded.n_samples_ == whole.n_samples_
    assert loaded.energy_kept_ == whole.energy_kept_


def test_arrays_travel_with_other_stages(tmp_path):
    """A caller may keep the arrays under names of its own."""
    kl = FlatKL(energy=0.9).fit(MAPS)
    arrays = {f"kl.{name}": array for name, array in kl.to_arrays().items()}
    store.save_arrays(tmp_path, kind="model", header={"kl": kl.settings()}, arrays=arrays)
    header, found = store.load_arrays(tmp_path, kind="model")
    loaded = FlatKL.from_arrays({name.removeprefix("kl."): array for name, array in found.items()}, **header["kl"])
    np.testing.assert_array_equal(loaded.transform(MAPS), kl.transform(MAPS))


def test_another_reading_is_refused(tmp_path):
    SequenceKL(gamma=0.5).fit(MAPS).save(tmp_path)
    with pytest.raises(ModelError, match="holds the reading 'sequence', wanted 'channel'"):
        ChannelKL.load(tmp_path)
    with pytest.raises(ModelError, match="another reading"):
        ChannelKL.from_arrays(FlatKL(gamma=0.5).fit(MAPS).to_arrays(), gamma=0.5)


@pytest.mark.parametrize("kind", [ChannelKL, FlatKL])
def test_settings_that_do_not_fit_the_arrays_are_refused(kind):
    with pytest.raises(ModelError, match="fit again"):
        kind.from_arrays(kind(components=2).fit(MAPS).to_arrays(), components=5)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("basis", np.zeros((3, 5), np.float32)),
        ("basis", np.zeros((3, 6))),
        ("mean", np.full(6, np.nan)),
        ("energies", np.array([1.0, 2, 3, 4, 5, 6])),
        ("energies", np.array([6.0, 5, 4, 3, 2, -1])),
        ("n_samples", np.array([0])),
        ("n_samples", np.array([[240]])),
        ("other", np.zeros(1)),
    ],
)
def test_damaged_arrays_are_refused(name, value):
    arrays = ChannelKL(components=3).fit(MAPS).to_arrays()
    with pytest.raises(ModelError):
        ChannelKL.from_arrays({**arrays, name: value}, components=3)


@pytest.mark.parametrize(
    ("name", "value"), [("shape", np.array([4, 3, 5])), ("energies", np.ones(2)), ("lost", np.array([-1.0]))]
)
def test_damaged_flat_arrays_are_refused(name, value):
    arrays = FlatKL(components=3).fit(MAPS).to_arrays()
    with pytest.raises(ModelError):
        FlatKL.from_arrays({**arrays, name: value}, components=3)


@pytest.mark.parametrize(
    "settings", [None, {"gamma": 0.5}, {"gamma": 2, "energy": None, "components": None, "whiten": False}]
)
def test_damaged_headers_are_refused(settings, tmp_path):
    ChannelKL(gamma=0.5).fit(MAPS).save(tmp_path)
    header = json.loads((tmp_path / store.HEADER).read_text())
    (tmp_path / store.HEADER).write_text(json.dumps({**header, "settings": settings}))
    with pytest.raises(ModelError):
        ChannelKL.load(tmp_path)


def test_missing_array_is_refused(tmp_path):
    ChannelKL(gamma=0.5).fit(MAPS).save(tmp_path)
    header, arrays = store.load_arrays(tmp_path, kind="kl")
    del arrays["mean"]
    store.save_arrays(tmp_path, kind="kl", header=header, arrays=arrays)
    with pytest.raises(ModelError, match="wanted"):
        ChannelKL.load(tmp_path)
