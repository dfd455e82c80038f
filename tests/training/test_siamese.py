"""The Siamese training: branches share weights, frozen layers stay, a killed run ends as an uninterrupted one."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from loopclosure import LoopDetector
from loopclosure.errors import ConfigError, FitError, ModelError
from loopclosure.features.backbones import Backbone
from loopclosure.images.decode import read_image
from loopclosure.store import TRAINED
from loopclosure.training.augment import Augmentation
from loopclosure.training.card import CARD
from loopclosure.training.checkpoint import CHECKPOINT
from loopclosure.training.data import open_data
from loopclosure.training.network import freeze, maps_of, open_backbone
from loopclosure.training.siamese import PairBatch, SiameseTask, _vectors, describe_images, train_siamese

LONGER = {"training.epochs": 3, "training.learning_rate": 5e-4, "training.seed": 1}

KILLED = """
import json, os, signal, sys
import torch
from loopclosure import Config
from loopclosure.training.siamese import train_siamese

torch.set_num_threads(1)
source, out, settings, last_step = sys.argv[1:]
steps = iter(range(1, 1000))

def progress(_):
    if next(steps) == int(last_step):
        os.kill(os.getpid(), signal.SIGKILL)

train_siamese(source, out, config=Config.from_dict(json.loads(settings)), progress=progress)
"""


def steps_of(source, config):
    """Every step of an uninterrupted training, as (epoch, step)."""
    return config.training.epochs * len(task_of(source, config).plan(0, 0))


def task_of(source, config, until="conv2"):
    backbone = open_backbone(config)
    freeze(backbone.module, until)
    return SiameseTask(backbone, open_data(source, config=config), config)


@pytest.fixture(scope="module")
def trained(class_tree, small, tmp_path_factory):
    """Folder and card of an uninterrupted training, made with one thread."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    out = tmp_path_factory.mktemp("siamese")
    card = train_siamese(class_tree, out, config=small.with_settings(LONGER))
    torch.set_num_threads(threads)
    return out, card


def test_killed_and_resumed_ends_with_the_same_numbers(class_tree, small, trained, tmp_path, same_threads):
    config = small.with_settings(LONGER)
    last_step = int(np.random.default_rng().integers(1, steps_of(class_tree, config) + 1))
    arguments = [class_tree, tmp_path, config.model_dump_json(), last_step]
    killed = subprocess.run([sys.executable, "-c", KILLED, *map(str, arguments)], capture_output=True, text=True)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    assert not (tmp_path / CARD).exists()
    out, card = trained
    resumed = train_siamese(class_tree, tmp_path, config=config, resume=True)
    assert resumed["history"] == card["history"], f"killed after step {last_step}"
    assert (tmp_path / TRAINED).read_bytes() == (out / TRAINED).read_bytes()


def test_the_folder(trained):
    out, card = trained
    assert {path.name for path in out.iterdir()} >= {TRAINED, CARD, CHECKPOINT, "header.json", "arrays.safetensors"}
    assert not list(out.glob("*.part"))
    assert json.loads((out / CARD).read_text()) == card
    assert card["seed"] == 1
    assert card["data"].startswith("24 images of 3 classes")
    assert card["parent_weights"]["licence"] == "none"
    assert card["history"][0]["train_loss"] is None
    assert card["best_epoch"] > 0
    assert card["after"]["pair_accuracy"] > card["before"]["pair_accuracy"]


def test_only_what_is_behind_the_frozen_layer_changes(class_tree, small, trained):
    out, _ = trained
    before, after = (
        Backbone("resnet18", "conv3", weights=weights, height=32, width=32).module.state_dict()
        for weights in ("random", str(out / TRAINED))
    )
    changed = {name for name, value in after.items() if not torch.equal(value, before[name])}
    learned = {name for name in after if name.startswith("parts.conv3") and name.endswith(("weight", "bias"))}
    assert changed == learned


def test_a_detector_learns_from_the_drive_with_the_trained_network(trained, drive, small, tmp_path):
    out, _ = trained
    images = [read_image(path) for path in sorted(drive.glob("*.png"))]
    moved = tmp_path / "moved"
    out_copy = LoopDetector(model=out)
    assert not out_copy.method.fitted
    out_copy.fit(images, source="drive")
    out_copy.save_model(moved)
    wanted = [(d.match, d.score) for d in out_copy.detect(images)]
    moved = moved.rename(tmp_path / "elsewhere")
    assert [(d.match, d.score) for d in LoopDetector(model=moved).detect(images)] == wanted
    assert LoopDetector(model=moved).config.features.weights == str(moved.resolve() / TRAINED)


def test_a_saved_detector_carries_the_network(trained, drive, tmp_path):
    out, _ = trained
    images = [read_image(path) for path in sorted(drive.glob("*.png"))]
    detector = LoopDetector(model=out)
    for image in images[:20]:
        detector.add(image)
    detector.save(tmp_path / "saved")
    loaded = LoopDetector.load((tmp_path / "saved").rename(tmp_path / "moved"))
    assert [loaded.add(image) for image in images[20:]] == [detector.add(image) for image in images[20:]]


def test_a_model_with_another_network_is_refused(trained, tmp_path, small):
    out, _ = trained
    detector = LoopDetector(model=out)
    detector.fit([np.full((32, 32, 3), i, np.uint8) for i in range(9)], source="x")
    detector.save_model(tmp_path)
    content = bytearray((tmp_path / TRAINED).read_bytes())
    content[-2] ^= 1
    (tmp_path / TRAINED).write_bytes(content)
    with pytest.raises(ModelError, match="fitted with"):
        LoopDetector(model=tmp_path)


@pytest.mark.parametrize("pairs", ["drawn", "all", "hardest"])
def test_the_loss_of_a_batch_by_hand(class_tree, small, pairs):
    config = small.with_settings({"training.augment": False, "training.pairs": pairs, "training.margin": 0.9})
    task = task_of(class_tree, config)
    batch = task.plan(0, 0)[0]
    images = open_data(class_tree, config=config).images
    numbers = np.unique(batch.pairs)
    vectors = describe_images(task._backbone, (images[int(i)] for i in numbers), config.training)
    vector = dict(zip(numbers.tolist(), vectors, strict=True))
    same = [(i, j) for (i, j), one in zip(batch.pairs, batch.same, strict=True) if one]
    different = [(i, j) for (i, j), one in zip(batch.pairs, batch.same, strict=True) if not one]
    if pairs != "drawn":
        most = len(batch.pairs) // 2 if pairs == "hardest" else None
        label = task.places.labels
        every = [(i, j) for i in numbers for j in numbers if i < j]
        by_distance = sorted(every, key=lambda pair: np.linalg.norm(vector[pair[0]] - vector[pair[1]]))
        different = [(i, j) for i, j in by_distance if label[i] != label[j]][:most]
        same = [(i, j) for i, j in by_distance[::-1] if label[i] == label[j]][:most]
    pull = [np.linalg.norm(vector[i] - vector[j]) for i, j in same]
    push = [max(0, 0.9 - np.linalg.norm(vector[i] - vector[j])) for i, j in different]
    assert float(task.loss(batch).detach()) == pytest.approx(
        np.mean(pull) + np.mean([term for term in push if term > 0]), abs=1e-4
    )


def test_the_gradient_of_one_weight_comes_from_both_branches(class_tree, small):
    """Both images of a pair move the same weights: with either held still the gradient is another."""
    config = small.with_settings({"training.augment": False, "training.pairs": "drawn"})
    task = task_of(class_tree, config)
    weight = task.parameters["parts.conv3.0.conv1.weight"]
    places = task.places.members
    pair = next((i, j) for i in places for j in places if task.places.labels[i] != task.places.labels[j])
    task.loss(PairBatch(np.array([pair]), np.array([False]), 0)).backward()
    both = weight.grad.clone()
    images = open_data(class_tree, config=config).images
    parts = []
    for moving in (0, 1):
        weight.grad = None
        vectors = [_vectors(task._backbone, [images[int(i)]], config.training) for i in pair]
        vectors[1 - moving] = vectors[1 - moving].detach()
        task._loss(torch.cat(vectors), (np.empty(0, int),) * 2, (np.array([0]), np.array([1]))).backward()
        assert weight.grad.norm() > 1e-6
        parts.append(weight.grad.clone())
    assert torch.allclose(both, parts[0] + parts[1], atol=1e-6)
    assert not torch.allclose(both, 2 * parts[0], atol=1e-6)


@pytest.mark.parametrize("until", ["nothing", "conv1", "conv3"])
def test_frozen_layers_by_a_few_images_give_the_maps_and_gradients_of_the_whole_chain(small, until):
    chain = open_backbone(small).module
    freeze(chain, until)
    inputs = torch.randn(7, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    learned = [value for value in chain.parameters() if value.requires_grad]
    (whole,), maps = chain(inputs), maps_of(chain, inputs)
    assert torch.allclose(maps, whole, rtol=1e-4, atol=1e-4 * float(whole.detach().abs().max()))
    if not learned:
        assert not maps.requires_grad
        return
    wanted, found = (torch.autograd.grad(values.square().mean(), learned) for values in (whole, maps))
    for one, other in zip(wanted, found, strict=True):
        assert torch.allclose(one, other, rtol=1e-3, atol=1e-4 * float(one.abs().max()))


def test_training_learns_the_classes(class_tree, small, tmp_path):
    config = small.with_settings({"training.epochs": 12, "training.freeze_until": "nothing", "training.augment": False})
    card = train_siamese(class_tree, tmp_path, config=config.with_settings({"training.patience": 0}))
    losses = [row["train_loss"] for row in card["history"][1:]]
    assert np.mean(losses[-3:]) < 0.9 * losses[0]


def test_pairs_of_poses_and_of_a_list_train_too(drive, class_tree, small, tmp_path):
    once = small.with_settings({"training.epochs": 1})
    assert train_siamese(drive, tmp_path / "poses", poses=drive / "poses.csv", config=once)["history"][1]["train_loss"]
    names = [f"{kind}/{i}.png" for kind in ("along", "spots") for i in range(6)]
    rows = [f"{a},{b},{int(a[0] == b[0])}" for a in names for b in names if a < b]
    listed = class_tree / "pairs.csv"
    listed.write_text("first,second,same\n" + "\n".join(rows))
    card = train_siamese(listed, tmp_path / "list", config=once.with_settings({"training.distance": "cosine"}))
    listed.unlink()
    assert card["history"][1]["train_loss"] > 0


def test_augmentation_is_the_seed_s_and_leaves_the_global_generator_alone(class_tree):
    image = read_image(next(iter(sorted((class_tree / "spots").glob("*.png")))))
    augment = Augmentation(32, 24)
    state = torch.random.get_rng_state()
    first, again, other = (augment([image, image], seed=seed) for seed in (0, 0, 1))
    assert torch.equal(torch.random.get_rng_state(), state)
    assert first[0].shape == (32, 24, 3)
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert not np.array_equal(first[0], first[1])
    assert not np.array_equal(first[0], other[0])


def test_wrong_settings(class_tree, small, tmp_path):
    with pytest.raises(ConfigError, match="did you mean 'conv2'"):
        train_siamese(class_tree, tmp_path, config=small.with_settings({"training.freeze_until": "conv22"}))
    with pytest.raises(ConfigError, match="nothing is left to train"):
        train_siamese(class_tree, tmp_path, config=small.with_settings({"training.freeze_until": "conv3"}))
    with pytest.raises(ConfigError, match="seqslam"):
        train_siamese(class_tree, tmp_path, config=small.with_settings({"method": "seqslam"}))
    assert not list(Path(tmp_path).iterdir())


def test_a_nan_in_training_is_one_error_and_the_checkpoint_stays(class_tree, small, tmp_path):
    wild = small.with_settings({"training.learning_rate": 1e30, "training.epochs": 5})
    with pytest.raises(FitError, match="learning_rate"):
        train_siamese(class_tree, tmp_path, config=wild)
    assert (tmp_path / CHECKPOINT).exists()
    assert not (tmp_path / CARD).exists()
