"""Settings: defaults run, unknown ones are refused with a guess, one rule for the KL size."""

from __future__ import annotations

import pytest

from loopclosure.config import PRESETS, Config, field_names
from loopclosure.errors import ConfigError


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_valid_and_survive_a_round_trip(name):
    config = Config.preset(name)
    assert Config.from_dict(config.model_dump(mode="json")) == config


def test_paper_preset_is_the_papers_table():
    config = Config.preset("paper")
    assert (config.features.backbone, config.features.layer) == ("resnet152", "conv5")
    assert (config.compression.gamma, config.aggregation.clusters, config.sequence.length) == (0.8, 64, 10)
    assert 1 - config.decision.threshold == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"sequence.lenght": 5}, r"unknown setting 'sequence.lenght', did you mean 'sequence.length'\?"),
        ({"compression.gamma": 1.0}, "compression.gamma = 1.0"),
        ({"decision.threshold": float("nan")}, "decision.threshold = nan"),
        ({"decision.threshold": "nan"}, "decision.threshold = 'nan'"),
        ({"sequence.length": 0}, "sequence.length = 0"),
        ({"sequence": 3}, "unknown setting 'sequence'"),
        ({"compression.gamma": None}, "exactly one of gamma, energy and components"),
        ({"compression.gamma": 0.5, "compression.energy": 0.5}, "found "),
        ({"compression.reading": "sequence", "compression.energy": 0.5}, "wants gamma or components"),
        ({"compression.reading": "sequence", "sequence.direction": "both"}, "wants another reading"),
    ],
)
def test_wrong_settings_are_one_line_errors(settings, message):
    with pytest.raises(ConfigError, match=message) as caught:
        Config().with_settings(settings)
    assert "\n" not in str(caught.value)


def test_wrong_values_in_python_are_our_errors_too():
    with pytest.raises(ConfigError, match=r"sequence\.length = 0"):
        Config(sequence={"length": 0})
    with pytest.raises(ConfigError, match="unknown setting 'sequense', did you mean"):
        Config(sequense={})


def test_a_threshold_belongs_to_one_method():
    paper = Config.preset("paper")
    assert paper.with_settings({"method": "seqslam"}).decision.threshold is None
    assert paper.with_settings({"method": "kl-netvlad"}).decision.threshold == 0.7


def test_text_is_converted():
    config = Config().with_settings(
        {"sequence.length": "5", "learning.refit_at": "40, 80", "compression.energy": "0.9"}
    )
    assert config.sequence.length == 5
    assert config.learning.refit_at == (40, 80)
    assert (config.compression.gamma, config.compression.energy) == (None, 0.9)


def test_a_network_brings_its_layer_unless_one_is_given():
    assert Config().features.layer == "s16"
    assert Config().with_settings({"features.backbone": "vgg16"}).features.layer == "conv5"
    chosen = Config().with_settings({"features.backbone": "vgg16", "features.layer": "conv3"})
    assert chosen.features.layer == "conv3"
    assert chosen.with_settings({"sequence.length": 3}).features.layer == "conv3"


def test_toml(tmp_path):
    file = tmp_path / "settings.toml"
    file.write_text('method = "kl-netvlad"\n[sequence]\nlength = 7\n')
    assert Config.from_toml(file).sequence.length == 7
    file.write_text("[sequence\n")
    with pytest.raises(ConfigError, match="not valid TOML"):
        Config.from_toml(file)
    with pytest.raises(ConfigError, match="cannot read the configuration"):
        Config.from_toml(tmp_path / "absent.toml")


def test_every_setting_is_described():
    described = Config().flat()
    assert set(described) == set(field_names())
    for section in Config.model_fields:
        value = getattr(Config(), section)
        assert all(field.description for field in getattr(type(value), "model_fields", {}).values())
