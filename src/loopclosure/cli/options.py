"""The flags that several commands share, made from the configuration itself so that the two cannot disagree."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import typer
from pydantic.fields import FieldInfo

from loopclosure.config import PRESETS, Config, Section, read_toml
from loopclosure.errors import ConfigError
from loopclosure.store import HEADER, load_header, saved_config

Json = Annotated[bool, typer.Option("--json", help="Print the result as one JSON object and nothing else.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no summary.")]

_FLAGS = {
    "method": "method",
    "backbone": "features.backbone",
    "layer": "features.layer",
    "weights": "features.weights",
    "backend": "features.backend",
    "gamma": "compression.gamma",
    "sequence_length": "sequence.length",
    "exclude_recent": "sequence.exclude_recent",
    "threshold": "decision.threshold",
    "false_loops_per_1000": "decision.false_loops_per_1000",
    "verification": "verification.mode",
    "on_error": "images.on_error",
}
"""Flag -> the setting that it sets."""


def configurable(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the common flags; it receives the `Config` that they make as its first argument.

    Settings are taken from, each over the one before: the preset (or the fitted `model`, or a saved detector given as
    `reference`), the TOML file, ``--set``, the flags.
    """
    own = list(inspect.signature(command, eval_str=True).parameters.values())[1:]

    @functools.wraps(command)
    def run(**given: Any) -> None:
        flags = {setting: given.pop(flag) for flag, setting in _FLAGS.items()}
        preset, file, pairs = given.pop("preset"), given.pop("config"), given.pop("set_")
        settings = read_toml(file) if file else {}
        settings |= dict(map(parse_pair, pairs or ()))
        settings |= {setting: value for setting, value in flags.items() if value is not None}
        command(_base(preset, given.get("model"), given.get("reference")).with_settings(settings), **given)

    return _with_parameters(run, [*own, *_source_parameters(), *(_flag_parameter(flag) for flag in _FLAGS)])


def options_of(section: type[Section]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command one flag for each field of `section`; it receives the section as its first argument."""

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        own = list(inspect.signature(command, eval_str=True).parameters.values())[1:]

        @functools.wraps(command)
        def run(**given: Any) -> None:
            values = {name: given.pop(name) for name in section.model_fields}
            command(section(**{name: value for name, value in values.items() if value is not None}), **given)

        fields = section.model_fields.items()
        return _with_parameters(run, [*own, *(_field_parameter(name, field) for name, field in fields)])

    return decorate


def _with_parameters(run: Callable[..., None], parameters: list[inspect.Parameter]) -> Callable[..., None]:
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    del run.__wrapped__  # type: ignore[attr-defined]  # typer would read the signature of the command itself
    return run


def _field_parameter(name: str, field: FieldInfo) -> inspect.Parameter:
    default = "" if field.default in (None, "") else f" (default: {field.default})"
    option = typer.Option(help=f"{field.description}{default}", show_default=False)
    return _keyword(name, Annotated[_type_of(field) | None, option])


def _type_of(field: FieldInfo) -> Any:
    """Return what the command line checks: a choice, a number, a switch, or else text."""
    union = get_origin(field.annotation) in (Union, UnionType)
    kinds = [kind for kind in get_args(field.annotation) if kind is not NoneType] if union else [field.annotation]
    known = len(kinds) == 1 and (get_origin(kinds[0]) is Literal or kinds[0] in (bool, int, float))
    return kinds[0] if known else str


def _base(preset: str | None, model: Path | None, reference: Path | None) -> Config:
    saved = {"model": model, "detector": reference if reference and (reference / HEADER).is_file() else None}
    folders = {kind: folder for kind, folder in saved.items() if folder is not None}
    if preset is not None or not folders:
        return Config.preset(preset or "default")
    kind, folder = next(iter(folders.items()))
    return saved_config(load_header(folder, kind=kind), folder)


def parse_pair(
    text: str, *, flag: str = "--set", wants: str = "stage.field=value, such as --set sequence.length=5"
) -> tuple[str, str]:
    """Take NAME=VALUE apart; `flag` and `wants` are for the error."""
    name, equals, value = text.partition("=")
    if not equals:
        raise ConfigError(f"{flag} {text}: wants {wants}")
    return name.strip(), value.strip()


def _source_parameters() -> list[inspect.Parameter]:
    pairs = typer.Option("--set", metavar="STAGE.FIELD=VALUE", help="Any setting; may be repeated.")
    return [
        _keyword("preset", Annotated[str | None, typer.Option(help=f"Settings to begin with: {', '.join(PRESETS)}.")]),
        _keyword("config", Annotated[Path | None, typer.Option(help="TOML file with one table a stage.")]),
        _keyword("set_", Annotated[list[str] | None, pairs]),
    ]


def _flag_parameter(flag: str) -> inspect.Parameter:
    section, _, field = _FLAGS[flag].rpartition(".")
    owner = type(getattr(Config(), section)) if section else Config
    return _field_parameter(flag, owner.model_fields[field])


def _keyword(name: str, annotation: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation)
