"""What a user may ask of a simulated drive."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, ValidationError

from loopclosure.config import Section, one_line
from loopclosure.errors import ConfigError

LightName = Literal["day", "dusk", "night"]


class SimulationSettings(Section):
    """Settings of a simulated drive; every default runs.

    Raises
    ------
    ConfigError
        For an unknown setting or a value out of range.

    Examples
    --------
    >>> SimulationSettings(frames=100).width
    320
    """

    frames: int = Field(300, ge=2, le=1_000_000, description="images of the drive, both laps together")
    seed: int = Field(0, ge=0, description="another seed is another street")
    width: int = Field(320, ge=32, le=4096, description="image width, pixels")
    height: int = Field(240, ge=32, le=4096, description="image height, pixels")
    spacing_m: float = Field(
        1.0, gt=0, le=10, description="distance between frames; more where few frames must fill the shortest lap"
    )
    revisit: bool = Field(True, description="False: one lap that never returns to a seen place")
    lateral_offset_m: float = Field(0.5, ge=-3, le=5, description="of the second lap, to the left of the first")
    direction: Literal["forward", "reverse"] = Field("forward", description="how the second lap drives the street")
    covered: float = Field(0.0, ge=0, le=0.8, description="mean share of the view behind moving people and cars")
    light: LightName = Field("day", description="of the first lap")
    revisit_light: LightName | None = Field(None, description="of the second lap; none = as the first")
    shadows: bool = Field(True, description="cast shadows; the sun stands elsewhere in each lap")
    parked_cars: bool = Field(True, description="parked cars, other ones in each lap")
    truth_radius_m: float | None = Field(
        None, gt=0, description="frames nearer than this show the same place; none = two frames along the street"
    )
    exclude_recent: int = Field(30, ge=1, description="frames nearer than this are no true matches")

    def __init__(self, **values: Any) -> None:
        try:
            super().__init__(**values)
        except ValidationError as error:
            raise ConfigError(one_line(error, SimulationSettings.model_fields)) from None
