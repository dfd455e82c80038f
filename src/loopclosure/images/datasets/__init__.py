"""Public data sets: where each comes from and under which terms, how its folder looks, how its truth is read.

>>> from loopclosure.images.datasets import open_dataset
>>> drive = open_dataset("kitti", "~/kitti", sequence="00")  # doctest: +SKIP
>>> truth = load_truth(drive.truth_path, frames=drive.frames, **drive.truth_settings)  # doctest: +SKIP
"""

from loopclosure.images.datasets.fetch import fetch_dataset
from loopclosure.images.datasets.layout import Finding, check_dataset, datasets_folder
from loopclosure.images.datasets.opening import OpenedDataset, open_dataset
from loopclosure.images.datasets.records import DATASETS, Dataset, Part, TruthRule, dataset_named

__all__ = [
    "DATASETS",
    "Dataset",
    "Finding",
    "OpenedDataset",
    "Part",
    "TruthRule",
    "check_dataset",
    "dataset_named",
    "datasets_folder",
    "fetch_dataset",
    "open_dataset",
]
