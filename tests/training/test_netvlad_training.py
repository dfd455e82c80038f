"""The NetVLAD training: the same arithmetic as in use, KL that stays, the hardest negatives, the layers below."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from loopclosure import LoopDetector
from loopclosure.errors import ConfigError, ModelError
from loopclosure.images.decode import read_image
from loopclosure.store import TRAINED, load_arrays
from loopclosure.training.card import CARD
from loopclosure.training.data import open_data
from loopclosure.training.netvlad import NetVLADTask, train_netvlad
from loopclosure.training.network import freeze, open_backbone


@pytest.fixture(scope="module")
def settings(small):
    """A learning rate at which two epochs tell."""
    return small.with_settings(
        {"compression.gamma": 0.6, "training.learning_rate": 0.001, "training.held_out": 0.25, "training.margin": 3.0}
    )


def task_of(drive, config, until="conv3"):
    backbone = open_backbone(config)
    freeze(backbone.module, until)
    return NetVLADTask(backbone, open_data(drive, poses=drive / "poses.csv", config=config), config)


def frames_of(drive):
    return [read_image(path) for path in sorted(drive.glob("*.png"))]


@pytest.mark.parametrize("reading", ["channel", "none"])
@pytest.mark.parametrize("until", ["conv3", "conv2"])
def test_a_detector_describes_as_training_did(drive, settings, tmp_path, reading, until):
    config = settings.with_settings({"compression.reading": reading, "training.freeze_until": until})
    train_netvlad(drive, tmp_path / "model", poses=drive / "poses.csv", config=config)
    assert (tmp_path / "model" / TRAINED).exists() == (until == "conv2")
    detector = LoopDetector(model=(tmp_path / "model").rename(tmp_path / "moved"))
    assert detector.learned_on == [f"32 frames with poses in {drive.name}"]
    described = np.stack([detector.method.describe(detector.method.features([image])) for image in frames_of(drive)])
    trained = task_of(drive, detector.config.with_settings({"training.epochs": 0}), until)
    _, arrays = load_arrays(tmp_path / "moved", kind="model")
    with torch.no_grad():
        for name, value in trained.network.layer.named_parameters():
            value.copy_(torch.from_numpy(arrays[f"netvlad.{name}"]))
    if reading == "channel" and until == "conv3":
        assert np.allclose(arrays["kl.basis"], trained.kl.basis_, atol=1e-5)
    elif reading == "channel":
        return  # with the trained network another basis would be fitted
    descriptors = trained.describe(np.arange(32))
    assert np.allclose(descriptors, described[:, : descriptors.shape[1]], atol=1e-5)
    assert np.allclose(arrays["mean_of_fit"], described.mean(axis=0), atol=1e-5)


def test_the_basis_is_that_of_the_first_network_and_stays(drive, settings, tmp_path):
    before = task_of(drive, settings, "conv2").kl.to_arrays()
    config = settings.with_settings({"training.freeze_until": "conv2"})
    train_netvlad(drive, tmp_path, poses=drive / "poses.csv", config=config)
    _, arrays = load_arrays(tmp_path, kind="model")
    assert np.array_equal(arrays["kl.basis"], before["basis"])


def test_training_begins_at_k_means_and_moves_from_there(drive, settings, tmp_path):
    start = task_of(drive, settings).network.layer.to_numpy()
    none = settings.with_settings({"training.epochs": 0})
    train_netvlad(drive, tmp_path / "start", poses=drive / "poses.csv", config=none)
    _, arrays = load_arrays(tmp_path / "start", kind="model")
    assert np.array_equal(arrays["netvlad.centres"], start.centres_)
    more = settings.with_settings({"training.epochs": 8, "training.patience": 0})
    card = train_netvlad(drive, tmp_path / "trained", poses=drive / "poses.csv", config=more)
    losses = [row["train_loss"] for row in card["history"][1:]]
    assert losses[-1] < losses[0]
    assert card == json.loads((tmp_path / "trained" / CARD).read_text())


def test_triplets_are_one_place_two_places_and_the_hardest(drive, settings):
    config = settings.with_settings({"training.negatives": 3})
    task = task_of(drive, config)
    places, members = task.places, task.places.members
    vectors = dict(zip(members.tolist(), task.describe(members), strict=True))
    batches = task.plan(0, 0)
    assert sum(len(np.unique(batch.triplets[:, 0])) for batch in batches) <= len(members)
    for query, positive, negative in np.concatenate([batch.triplets for batch in batches]).tolist():
        away = {i: np.linalg.norm(places.positions[query] - places.positions[i]) for i in members.tolist()}
        squared = {i: float(((vectors[query] - vectors[i]) ** 2).sum()) for i in members.tolist()}
        positives = [i for i in away if away[i] <= 1.5 and abs(i - query) >= 8]
        negatives = sorted((i for i in away if away[i] > 3.0), key=squared.get)
        assert squared[positive] == pytest.approx(min(squared[i] for i in positives), abs=1e-6)
        assert squared[negative] <= squared[negatives[2]] + 1e-6
        assert squared[negative] < squared[positive] + 3.0 + 1e-6


def test_a_small_pool_leaves_easier_negatives(drive, settings):
    hard, easy = (
        task_of(drive, settings.with_settings({"training.negatives": 1, "training.pool": pool})).plan(0, 0)
        for pool in (1000, 1)
    )
    assert sum(len(batch.triplets) for batch in easy) <= sum(len(batch.triplets) for batch in hard)


def test_rounds_take_each_query_once_an_epoch(drive, settings):
    task = task_of(drive, settings.with_settings({"training.round": 5, "training.margin": 3.9}))
    queries = [batch.triplets[:, 0] for part in range(task.rounds) for batch in task.plan(0, part)]
    found, counts = np.unique(np.concatenate([np.unique(some) for some in queries]), return_counts=True)
    assert task.rounds == -(-len(task.places.anchors(1)) // 5)
    assert found.tolist() == task.places.anchors(1).tolist()
    assert (counts == 1).all()


def test_resumed_is_the_same_as_uninterrupted(drive, settings, tmp_path, same_threads):
    class StoppedError(Exception):
        pass

    def stop(now):
        if (now.epoch, now.step) == (1, 2):
            raise StoppedError

    config = settings.with_settings({"training.round": 6, "training.epochs": 3})
    whole = train_netvlad(drive, tmp_path / "whole", poses=drive / "poses.csv", config=config)
    with pytest.raises(StoppedError):
        train_netvlad(drive, tmp_path / "cut", poses=drive / "poses.csv", config=config, progress=stop)
    resumed = train_netvlad(drive, tmp_path / "cut", poses=drive / "poses.csv", config=config, resume=True)
    assert resumed["history"] == whole["history"]
    other = config.with_settings({"training.margin": 0.2})
    with pytest.raises(ModelError, match=r"training.margin = 3.0, here it is 0.2"):
        train_netvlad(drive, tmp_path / "cut", poses=drive / "poses.csv", config=other, resume=True)


def test_methods_without_a_layer_are_refused(drive, settings, tmp_path):
    for other in ({"method": "cnn"}, {"compression.reading": "flat"}):
        with pytest.raises(ConfigError, match="no NetVLAD layer"):
            train_netvlad(drive, tmp_path, poses=drive / "poses.csv", config=settings.with_settings(other))
