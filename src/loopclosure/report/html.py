"""Pages from templates; pictures go inside, so that a page needs nothing but itself."""

from __future__ import annotations

import base64
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

PIXELS_PER_INCH = 100
"""Width of a figure on a page, so that the text of all figures has one size."""


def render(template: str, **values: Any) -> str:
    """Fill a template of this folder; text is escaped, and what a name holds that is no text is replaced."""
    environment = Environment(
        loader=PackageLoader("loopclosure", "report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    page = environment.get_template(template).render(**values)
    return page.encode("utf-8", "replace").decode("utf-8")


def embed(picture: bytes) -> str:
    """Return a PNG as a data URI."""
    return f"data:image/png;base64,{base64.b64encode(picture).decode('ascii')}"
