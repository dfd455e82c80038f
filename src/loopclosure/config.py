"""Settings: one frozen section a stage, every default runs, an unknown key is an error that guesses.

The command line and the Python interface take their defaults from here and nowhere else.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from loopclosure.errors import ConfigError, did_you_mean

if sys.version_info >= (3, 11):
    import tomllib
else:  # pragma: no cover
    import tomli as tomllib

MAX_CONFIG_BYTES = 1 << 20
EMBEDDED = "efficientnet-lite0"
"""The backbone whose weights are installed with the library."""


class Section(BaseModel):
    """Base of all sections: frozen, no unknown keys, no NaN."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, protected_namespaces=())


class Images(Section):
    """How images are read."""

    on_error: Literal["stop", "skip"] = Field("stop", description="what an unreadable image does")
    max_megapixels: float = Field(64.0, gt=0, description="a larger image is refused before it is decoded")


class Features(Section):
    """Images to feature maps (paper 2.1)."""

    backbone: str = Field(EMBEDDED, description="network, see `loopclosure weights`")
    layer: str = Field("", description="tap: conv1..conv5, or s4 s8 s16 s32 of efficientnet-lite0")
    weights: str = Field("default", description="'default', a name, a path, or 'random'")
    height: int = Field(224, ge=32, le=2048, description="input height, pixels")
    width: int = Field(224, ge=32, le=2048, description="input width, pixels")
    backend: Literal["auto", "openvino", "torch"] = Field(
        "auto", description="what executes the network; auto = openvino where it is installed"
    )

    @model_validator(mode="before")
    @classmethod
    def _default_layer(cls, values: Any) -> Any:
        """Without a layer: the only or the best one of networks that have no conv5, the paper's conv5 of the others."""
        if isinstance(values, dict) and not values.get("layer"):
            return values | {"layer": _LAYERS.get(str(values.get("backbone", EMBEDDED)), "conv5")}
        return values


class Compression(Section):
    """The Karhunen-Loeve transform (paper 2.2). One of `gamma`, `energy` and `components` rules."""

    reading: Literal["channel", "sequence", "flat", "none"] = Field(
        "none", description="how Eq. 5-16 are read in front of NetVLAD; a ratio that is set makes it 'channel'"
    )
    gamma: Annotated[float, Field(ge=0, lt=1)] | Literal["auto"] | None = Field(
        0.6, description="share of the eigenvectors that is cut away (Eq. 16); 'auto' chooses it from the images"
    )
    energy: float | None = Field(None, gt=0, le=1, description="share of the energy that is kept (Eq. 15)")
    components: int | None = Field(None, ge=1, description="number of eigenvectors that is kept")
    whiten: bool = Field(False, description="scale every component to unit variance")

    @model_validator(mode="after")
    def _one_rule(self) -> Compression:
        given = [name for name in ("gamma", "energy", "components") if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"wants exactly one of gamma, energy and components, found {given or 'none'}")
        if self.gamma == "auto" and self.reading != "channel":
            raise ValueError(f"gamma = auto is for the reading 'channel', found '{self.reading}'")
        if self.reading == "sequence" and self.energy is not None:
            raise ValueError("the reading 'sequence' wants gamma or components: by energy, sequences differ in size")
        return self


class Aggregation(Section):
    """Many local vectors to one descriptor (paper 2.3, Eq. 19)."""

    clusters: int = Field(64, ge=1, le=4096, description="NetVLAD clusters K")
    centre_window: int = Field(
        60, ge=0, description="frames whose mean descriptor is taken out of each new one; 0 = nothing is taken out"
    )
    components: int = Field(
        64,
        ge=0,
        le=4096,
        description="numbers that NetVLAD, and the layout, are each reduced to, whitened (needs centring); 0 = all of "
        "NetVLAD are kept",
    )
    layout_weight: float = Field(
        0.7, ge=0, le=10, description="weight of the layout of the view beside NetVLAD, both whitened; 0 = none"
    )
    change_over: int = Field(
        5,
        ge=0,
        le=100,
        description="frames in which a part of the view must have changed to count in full, where descriptors are "
        "whitened; 0 = all parts count",
    )

    @property
    def whitened(self) -> bool:
        """Whether descriptors are reduced to whitened numbers: only what is centred can be."""
        return bool(self.centre_window and self.components)

    @property
    def part_weights(self) -> tuple[float, ...]:
        """Of NetVLAD, and of the layout where that stands beside it."""
        return (1.0, self.layout_weight) if self.whitened and self.layout_weight else (1.0,)


class Learning(Section):
    """What is learned from the images themselves where no fitted model is given."""

    warm_up: int = Field(
        30, ge=1, description="in one stream: frames of the first fit, never more than sequence.exclude_recent"
    )
    fit_frames: int = Field(500, ge=2, description="at most so many frames of a known traverse are fitted on")
    refit_at: tuple[int, ...] = Field(
        (60, 120, 240), description="in one stream: frame counts at which basis and clusters are learned anew"
    )
    max_kept_mb: float = Field(512.0, gt=0, description="memory for the maps that refits need; above it they end")
    seed: int = Field(0, ge=0, description="of k-means and of samples")


class Sequence(Section):
    """Distance between image sequences (paper 2.3, Eq. 20)."""

    length: int = Field(10, ge=1, le=10_000, description="frames l in a sequence")
    exclude_recent: int = Field(30, ge=1, description="in one stream: frames nearer than this are no candidates")
    direction: Literal["forward", "both"] = Field("forward", description="'both' also finds a street driven back")


class Matching(Section):
    """A frame against the map."""

    flat_up_to: int = Field(
        50_000,
        ge=1,
        description="places up to which a frame is compared with all; an index finds the candidates in larger maps of "
        "whitened descriptors",
    )


class SeqSlam(Section):
    """Thumbnails of the method `seqslam`."""

    width: int = Field(64, ge=8, le=1024, description="thumbnail width, pixels, a multiple of 8")
    height: int = Field(32, ge=8, le=1024, description="thumbnail height, pixels, a multiple of 8")
    faithful: bool = Field(False, description="OpenSeqSLAM's own thumbnails and local contrast instead of better ones")


class Words(Section):
    """Local features and visual words of the methods `fabmap`, `bow` and `bow-incremental`."""

    keypoints: Literal["rootsift", "orb"] = Field("rootsift", description="what detects and describes local features")
    max_features: int = Field(1000, ge=1, le=20_000, description="at most so many features an image")
    side: int = Field(640, ge=32, le=4096, description="longer side to which an image is scaled first, pixels")
    branching: int = Field(100, ge=2, le=10_000, description="clusters of each node of the vocabulary tree")
    levels: int = Field(2, ge=1, le=8, description="depth of the tree: up to branching ** levels words")


class Onnx(Section):
    """The user's own network, for the method `onnx` and the backbone of that name."""

    path: str = Field("", description="file NETWORK.onnx, with NETWORK.json beside it")


class Decide(Section):
    """From the best score to a decision."""

    false_loops_per_1000: float = Field(
        0.15, gt=0, le=1000, description="false loops that are allowed in 1000 frames, where a score is a probability"
    )
    threshold: float | None = Field(
        None, description="least score of a loop; none = by false_loops_per_1000, or the method's own"
    )
    consistency: int = Field(
        10,
        ge=1,
        description="frames over which the best candidate must have moved on with the robot, where a score is a "
        "similarity; 1 = not asked",
    )


class Verification(Section):
    """Whether local features confirm a loop."""

    mode: Literal["none", "fast", "strict"] = Field(
        "fast", description="'strict' takes twice the local features of 'fast', and longer"
    )
    every: int = Field(3, ge=1, le=100, description="a small picture is kept of every so many frames")


class Training(Section):
    """Gradient training (paper 2.1; Arandjelovic et al. 2016, section 4)."""

    epochs: int = Field(15, ge=0, le=10_000, description="passes over the training images")
    batch: int = Field(16, ge=1, le=4096, description="pairs, or queries, a step")
    learning_rate: float | None = Field(None, gt=0, description="none = siamese 3e-4 (AdamW), netvlad 1e-4 (SGD)")
    halve_every: int = Field(5, ge=0, description="epochs after which the learning rate is halved; 0 = never")
    momentum: float = Field(0.9, ge=0, lt=1, description="netvlad: of SGD")
    weight_decay: float = Field(1e-3, ge=0, description="of SGD or AdamW")
    patience: int = Field(5, ge=0, description="epochs without a better held-out measure before it stops; 0 = never")
    held_out: float = Field(0.2, gt=0, lt=1, description="share of the data that measures and is not learned from")
    freeze_until: str | None = Field(
        None,
        description="last layer that stays as it is, or 'nothing'; none = all but the last stage for siamese, "
        "the whole network for netvlad",
    )
    augment: bool = Field(True, description="crop, colour, blur and occluders, drawn anew for each image")
    distance: Literal["euclidean", "cosine"] = Field("euclidean", description="of the contrastive loss of siamese")
    margin: float | None = Field(None, gt=0, description="none = 1 for siamese, 0.1 for netvlad")
    pairs: Literal["drawn", "all", "hardest"] = Field(
        "all", description="siamese: the pairs drawn, all that are known among their images, or the hardest of these"
    )
    negatives: int = Field(10, ge=1, le=1000, description="netvlad: hardest negatives a query")
    pool: int = Field(1000, ge=1, description="netvlad: negatives drawn for each query, to choose the hardest from")
    round: int = Field(
        1000, ge=1, description="pairs, or queries, between checkpoints; netvlad renews there what it mines from"
    )
    positive_m: float = Field(10.0, gt=0, description="poses nearer than this are one place, metres")
    negative_m: float = Field(25.0, gt=0, description="poses farther apart than this are two places, metres")
    device: str = Field("auto", description="'auto' = a GPU where there is one; or cpu, cuda, cuda:1 ...")
    precision: Literal["auto", "float32", "bfloat16"] = Field(
        "auto", description="bfloat16 is mixed precision; auto = that on a GPU that has it"
    )
    seed: int = Field(0, ge=0, description="of what is held out, drawn and augmented")

    @model_validator(mode="after")
    def _apart(self) -> Training:
        if self.negative_m < self.positive_m:
            raise ValueError(f"negative_m = {self.negative_m:g} is less than positive_m = {self.positive_m:g}")
        return self


class Config(Section):
    """All settings of a detector.

    Examples
    --------
    >>> Config().sequence.length
    10
    >>> Config.preset("paper").compression.gamma
    0.8
    >>> Config().with_settings({"sequence.length": 5}).sequence.length
    5
    """

    method: str = Field("kl-netvlad", description="see `loopclosure methods`")
    images: Images = Images()
    features: Features = Field(default_factory=lambda: Features.model_validate({}))
    compression: Compression = Compression()
    aggregation: Aggregation = Aggregation()
    learning: Learning = Learning()
    matching: Matching = Matching()
    sequence: Sequence = Sequence()
    decision: Decide = Decide()
    verification: Verification = Verification()
    seqslam: SeqSlam = SeqSlam()
    words: Words = Words()
    onnx: Onnx = Onnx()
    training: Training = Training()

    def __init__(self, **values: Any) -> None:
        try:
            super().__init__(**values)
        except ValidationError as error:
            raise ConfigError(one_line(error, field_names())) from None

    @model_validator(mode="after")
    def _one_way(self) -> Config:
        if self.compression.gamma == "auto" and self.method not in ("kl-netvlad", "onnx"):
            raise ValueError(f"compression.gamma = auto is for the method kl-netvlad, found {self.method}")
        if self.sequence.direction == "both" and self.compression.reading == "sequence":
            raise ValueError(
                "sequence.direction = both wants another reading than 'sequence': eigen-images have no direction"
            )
        return self

    @model_validator(mode="before")
    @classmethod
    def _what_the_name_says(cls, values: Any) -> Any:
        """Fill in what the method's name says, where nothing else is given."""
        method = str(values.get("method")) if isinstance(values, dict) else ""
        for name, value in METHOD_SETTINGS.get(method, {}).items():
            section, _, field = name.partition(".")
            given = values.get(section, {})
            if isinstance(given, dict):
                values = values | {section: {field: value, **given}}
        return values

    @classmethod
    def preset(cls, name: str) -> Config:
        """Return the preset `name`; see `PRESETS`."""
        if name not in PRESETS:
            raise ConfigError(f"unknown preset '{name}'{did_you_mean(name, PRESETS)}; known: {', '.join(PRESETS)}")
        return cls().with_settings(PRESETS[name])

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Config:
        """Build a configuration from nested mappings, as `model_dump` and TOML files give them."""
        return cls().with_settings(_flatten(values))

    @classmethod
    def from_toml(cls, path: str | os.PathLike[str]) -> Config:
        """Read a TOML file with one table a stage over the defaults."""
        return cls().with_settings(read_toml(path))

    def flat(self) -> dict[str, Any]:
        """Return every setting by its ``"stage.field"`` name."""
        return _flatten(self.model_dump())

    def with_settings(self, settings: Mapping[str, Any]) -> Config:
        """Return a copy with ``"stage.field"`` settings replaced.

        Text is converted to the type of the field. Setting one of ``compression.gamma``, ``.energy`` and
        ``.components`` clears the other two, because only one of them can rule; setting ``features.backbone`` alone
        chooses that network's default layer; setting ``method`` also sets what its name says (`METHOD_SETTINGS`), where
        that is not given too.

        Raises
        ------
        ConfigError
            For an unknown name (with the nearest known one) or a value out of range.
        """
        known = field_names()
        values = self.model_dump()
        settings = METHOD_SETTINGS.get(str(settings.get("method")), {}) | dict(settings)
        if settings.get("method", self.method) != self.method:
            settings = {"decision.threshold": None} | settings  # a threshold holds for the scores of one method
        if "features.backbone" in settings:
            values["features"]["layer"] = None
        if any(settings.get(f"compression.{rule}") not in (None, "none") for rule in _RULES):
            values["compression"].update(dict.fromkeys(_RULES))
            if values["compression"]["reading"] == "none" and settings.get("method", self.method) in _COMPRESSING:
                values["compression"]["reading"] = "channel"
        for name, value in settings.items():
            if name not in known:
                raise ConfigError(f"unknown setting '{name}'{did_you_mean(name, known)}")
            section, _, field = name.rpartition(".")
            target = values[section] if section else values
            target[field] = _parse(name, value)
        return Config(**values)


_RULES = ("gamma", "energy", "components")
_COMPRESSING = ("kl-netvlad", "onnx")  # a ratio alone says that local vectors are to be compressed
_LAYERS = {EMBEDDED: "s16", "fasterrcnn_resnet50_fpn": "fpn", "onnx": "output"}

PRESETS: dict[str, dict[str, Any]] = {
    "default": {},
    "paper": {
        "features.backbone": "resnet152",
        "features.layer": "conv5",
        "compression.reading": "channel",
        "compression.gamma": 0.8,
        "aggregation.clusters": 64,
        "aggregation.centre_window": 0,
        "aggregation.components": 0,
        "verification.mode": "none",
        "sequence.length": 10,
        "decision.threshold": 0.7,
        "decision.consistency": 1,
    },
}
"""Named configurations: settings over the defaults."""

METHOD_SETTINGS: dict[str, dict[str, Any]] = {
    "netvlad-resnet152": {
        "features.backbone": "resnet152",
        "compression.reading": "none",
        "aggregation.components": 0,
    },
    "netvlad-vgg16": {"features.backbone": "vgg16", "compression.reading": "none", "aggregation.components": 0},
    "faster-rcnn": {
        "features.backbone": "fasterrcnn_resnet50_fpn",
        "features.height": 480,
        "features.width": 640,
    },
    "onnx": {"features.backbone": "onnx"},
}
"""What the name of a method says: settings over the defaults, under those that are given."""


def field_names() -> list[str]:
    """Return every setting as ``"stage.field"``, in the order of the stages."""
    names = []
    for name, field in Config.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, Section):
            names += [f"{name}.{inner}" for inner in field.annotation.model_fields]
        else:
            names.append(name)
    return names


def read_toml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a TOML file into ``"stage.field"`` settings."""
    file = Path(path)
    try:
        if file.stat().st_size > MAX_CONFIG_BYTES:
            raise ConfigError(f"{file} is larger than {MAX_CONFIG_BYTES} bytes: it is no configuration")
        return _flatten(tomllib.loads(file.read_text(encoding="utf-8")))
    except OSError as error:
        raise ConfigError(f"cannot read the configuration {file}: {error.strerror or error}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(f"{file} is not valid TOML: {error}") from None


def _flatten(values: Mapping[str, Any]) -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            flat.update({f"{name}.{inner}": inner_value for inner, inner_value in value.items()})
        else:
            flat[name] = value
    return flat


def _parse(name: str, value: Any) -> Any:
    if not isinstance(value, str):
        return value
    if value.lower() in ("none", "null") and name not in ("compression.reading", "verification.mode"):
        return None
    if name == "learning.refit_at":
        return [part for part in value.replace(",", " ").split() if part]
    return value


def one_line(error: ValidationError, known: Iterable[str] = ()) -> str:
    """Say what the first problem of a validation is, in one line, with a guess for an unknown name."""
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"][:2])  # behind them: which of several types was tried
    message = str(first["msg"]).removeprefix("Value error, ")
    if first["type"] == "extra_forbidden":
        return f"unknown setting '{where}'{did_you_mean(where, known)}"
    if first["type"] == "value_error":
        return f"{where}: {message}" if where else message
    return f"{where} = {first.get('input')!r}: {message[0].lower()}{message[1:]}"
