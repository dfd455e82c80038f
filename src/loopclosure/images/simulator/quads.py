"""Rectangles in space: all that the renderer knows."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from loopclosure.images.simulator.surface import Texture


class Lazy:
    """A texture that is painted when it is first seen."""

    def __init__(self, make: Callable[[], Texture]) -> None:
        self._make = make
        self._texture: Texture | None = None

    def get(self) -> Texture:
        """Return the texture."""
        if self._texture is None:
            self._texture = self._make()
        return self._texture


class Quads:
    """Rectangles, each with its texture.

    Attributes
    ----------
    textures : list of Lazy
        One a rectangle.
    """

    def __init__(self) -> None:
        self.textures: list[Lazy] = []
        self._edges: list[np.ndarray] = [np.zeros((0, 3, 3))]
        self._tints: list[np.ndarray] = [np.zeros((0, 3))]
        self._facing: list[np.ndarray] = [np.zeros(0, bool)]

    def __len__(self) -> int:
        return len(self.textures)

    def add(
        self, origin: np.ndarray, across: np.ndarray, down: np.ndarray, texture: Lazy, tint: np.ndarray | None = None
    ) -> None:
        """Add a rectangle that is seen from the front only.

        Parameters
        ----------
        origin, across, down : ndarray, (3,)
            Upper left corner and the two edges, metres, as a viewer in front of it sees them.
        texture : Lazy
        tint : ndarray, (3,), or None
            Light on a texture that was painted without light.
        """
        self.add_many(np.stack([across, down, origin], axis=1)[None], [texture], None if tint is None else tint[None])

    def add_facing(
        self, foot: np.ndarray, width_m: float, height_m: float, texture: Lazy, tint: np.ndarray | None = None
    ) -> None:
        """Add an upright picture that always faces the camera, standing on `foot`; a negative width mirrors it."""
        tints = None if tint is None else tint[None]
        self.add_many_facing(foot[None], np.array([width_m]), height_m, [texture], tints)

    def add_many_facing(
        self,
        feet: np.ndarray,
        widths_m: np.ndarray,
        height_m: float,
        textures: Sequence[Lazy],
        tints: np.ndarray | None = None,
    ) -> None:
        """Add pictures that always face the camera on feet (n, 3); a negative width mirrors one."""
        edges = np.zeros((len(feet), 3, 3))
        edges[:, 0, 0], edges[:, 2, 1], edges[:, :, 2] = widths_m, -height_m, feet + np.array([0, 0, height_m])
        self.add_many(edges, textures, tints, facing=True)

    def add_many(
        self, edges: np.ndarray, textures: Sequence[Lazy], tints: np.ndarray | None = None, *, facing: bool = False
    ) -> None:
        """Add rectangles (n, 3, 3), whose columns are across, down and origin, with tints (n, 3)."""
        self.textures += textures
        self._edges.append(edges)
        self._tints.append(np.ones((len(edges), 3)) if tints is None else tints)
        self._facing.append(np.full(len(edges), facing))

    def extend(self, other: Quads) -> None:
        """Append all rectangles of `other`."""
        self.textures += other.textures
        self._edges += other._edges
        self._tints += other._tints
        self._facing += other._facing

    def solid(self) -> Quads:
        """Return the same rectangles with rough shapes for pictures: enough to know about what they hide."""
        edges, _, facing = self.arrays()
        quads = Quads()
        quads.add_many(edges[~facing], [_BLANK] * int((~facing).sum()))
        quads.add_many(edges[facing], [_CROWN] * int(facing.sum()), facing=True)
        return quads

    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return edges (n, 3, 3), tints (n, 3), and which rectangles turn towards the camera (n,)."""
        for chunks in (self._edges, self._tints, self._facing):
            if len(chunks) > 1:
                chunks[:] = [np.concatenate(chunks)]
        return self._edges[0], self._tints[0], self._facing[0]


def _crown() -> Texture:
    """Paint a tree, or near enough what else faces the camera."""
    alpha = np.zeros((64, 64), np.uint8)
    cv2.ellipse(alpha, (32, 23), (29, 22), 0, 0, 360, 255, -1)
    alpha[40:, 29:35] = 255
    return Texture(np.zeros((64, 64, 3), np.uint8), alpha)


_BLANK, _CROWN = Lazy(lambda: Texture(np.zeros((8, 8, 3), np.uint8))), Lazy(_crown)
