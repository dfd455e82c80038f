"""What the paper reports, to stand beside what is measured here: Jiang, Zhou, Sun, Appl. Sci. 2024, 14(1), 8.

Recall at 100 % precision in percent. The text says that Table 6 was made at a ratio of 80 %, but its figures for the
paper's own method are the 90 % column of Tables 4 and 5; Table 7 does not name its machine.
"""

from __future__ import annotations

from dataclasses import dataclass

BACKBONE = "resnet152"
GAMMAS = (0.6, 0.7, 0.8, 0.9)
"""Compression ratios of Table 3."""
TEXT_GAMMA, FIGURE_GAMMA = 0.8, 0.9
"""The ratio of Table 6 by its text, and by its figures."""


@dataclass(frozen=True)
class PaperMethod:
    """A row of Tables 6 and 7."""

    title: str
    recall: dict[str, float]
    milliseconds: float


@dataclass(frozen=True)
class PaperSet:
    """What the paper calls the results on one data set."""

    title: str
    table: str
    truth_figure: str
    distance_figure: str
    layers_figure: str
    methods_figure: str


SETS = {
    "new-college": PaperSet("New College", "Table 4", "Figure 17", "Figure 18", "Figure 20", "Figure 22"),
    "city-centre": PaperSet("City Centre", "Table 5", "Figure 17", "Figure 19", "Figure 21", "Figure 23"),
}
ANY_SET = PaperSet("", "Tables 4 and 5", "Figure 17", "Figures 18 and 19", "Figures 20 and 21", "Figures 22 and 23")

_BY_LAYER: dict[str, dict[str, tuple[float, float, float, float]]] = {
    "new-college": {
        "conv1": (14.62, 14.23, 12.69, 9.41),
        "conv2": (14.22, 13.76, 18.31, 16.58),
        "conv3": (25.34, 26.86, 30.21, 28.17),
        "conv4": (30.67, 28.52, 40.07, 45.69),
        "conv5": (27.88, 24.39, 46.55, 60.14),
    },
    "city-centre": {
        "conv1": (33.64, 39.72, 37.88, 29.17),
        "conv2": (38.72, 47.38, 42.39, 37.54),
        "conv3": (48.13, 46.75, 50.21, 47.68),
        "conv4": (62.54, 71.42, 69.01, 63.87),
        "conv5": (75.65, 75.09, 73.42, 73.38),
    },
}


def recall_of_layer(data_set: str, backbone: str, layer: str, gamma: float | None) -> float | None:
    """Return a cell of Table 4 or 5; None where the paper has no such cell.

    Examples
    --------
    >>> recall_of_layer("new-college", "resnet152", "conv5", 0.9)
    60.14
    """
    row = _BY_LAYER.get(data_set, {}).get(layer) if backbone == BACKBONE else None
    return row[GAMMAS.index(gamma)] if row and gamma in GAMMAS else None


OURS = PaperMethod("ResNet152 conv5 + KL + NetVLAD", {"new-college": 60.14, "city-centre": 73.38}, 13.73)
METHODS = {
    "seqslam": PaperMethod("SeqSLAM", {"new-college": 42.39, "city-centre": 47.16}, 32.16),
    "fabmap": PaperMethod("FAB-MAP", {"new-college": 49.10, "city-centre": 52.09}, 44.27),
    "netvlad-resnet152": PaperMethod("ResNet152 + NetVLAD", {"new-college": 54.38, "city-centre": 58.23}, 17.95),
    "netvlad-vgg16": PaperMethod("VGG16 + NetVLAD", {"new-college": 52.11, "city-centre": 44.26}, 24.89),
    "faster-rcnn": PaperMethod("Faster R-CNN", {"new-college": 42.57, "city-centre": 36.85}, 11.62),
}
"""Rows of Tables 6 and 7, by the names that these methods have here."""
