"""What the benchmark measures is what it says; no time is asserted."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from loopclosure.cli import app
from loopclosure.cli.bench import _page
from loopclosure.config import Config
from loopclosure.errors import ConfigError, LoopClosureError
from loopclosure.evaluation.eager import EagerPipeline
from loopclosure.evaluation.speed import Contest, measure_speed, take_turns
from loopclosure.images.simulator import SimulationSettings, simulate

CONFIG = Config().with_settings({"aggregation.clusters": 8})


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    settings = SimulationSettings(frames=40, spacing_m=6.0, width=160, height=120, parked_cars=False)
    return simulate(tmp_path_factory.mktemp("speed") / "drive", settings) / "images"


def test_ratios_are_taken_round_by_round() -> None:
    contest = Contest({"a": [10.0, 30.0, 20.0], "b": [1.0, 10.0, 10.0]})
    assert contest.median("a") == 20
    assert contest.ratio("a", "b") == 3  # of 10, 3, 2, not 20 / 10


def test_turns_alternate_and_the_first_round_does_not_count() -> None:
    order: list[str] = []
    contest = take_turns({"a": lambda: order.append("a"), "b": lambda: order.append("b")}, 2)
    assert order == ["a", "b"] * 3
    assert [len(times) for times in contest.milliseconds.values()] == [2, 2]


def test_the_eager_pipeline_is_torchs(drive: Path) -> None:
    files = sorted(drive.iterdir())[:4]
    eager = EagerPipeline(CONFIG, files)
    assert 0.4e9 < eager.flop < 0.8e9  # 407 million multiply-adds in the whole network, the head left out
    for file in files:
        eager(file)
    assert eager(files[2]) == 2  # of all earlier images, itself


def test_the_command(drive: Path) -> None:
    arguments = ["bench", "--images", str(drive), "--frames", "2", "--rounds", "1", "--set", "aggregation.clusters=8"]
    found = CliRunner().invoke(app, [*arguments, "--json"])
    assert found.exit_code == 0, found.output
    result = json.loads(found.stdout)
    stages = ["decode", "resize", "backbone", "kl", "netvlad", "reduce", "search in 1000", "picture", "decide"]
    assert list(result["stages_ms"]) == stages
    assert min(result["stages_ms"].values()) > 0
    assert set(result["times_faster_than_eager"]) == {"throughput", "latency"}
    assert 0 < result["share_of_matmul_limit"] < 2
    assert (result["network"], result["runtime"]) == ("efficientnet-lite0 s16", "openvino")
    assert "% of the" in _page(result)


def test_what_cannot_be_measured_is_said() -> None:
    with pytest.raises(ConfigError, match="stages of kl-netvlad, found method = seqslam"):
        measure_speed(CONFIG.with_settings({"method": "seqslam"}))
    with pytest.raises(LoopClosureError):
        measure_speed(CONFIG, images="/no/such/folder")
