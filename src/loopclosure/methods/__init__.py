"""THE table: method name -> how it is built. Adding a method is one file and one line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from loopclosure.config import Config
from loopclosure.errors import ConfigError, did_you_mean
from loopclosure.methods.base import Method, PlaceMap, Scores

ProgressCallback = Callable[[int, int], None]


@dataclass(frozen=True)
class MethodEntry:
    """One row of the table.

    Attributes
    ----------
    summary : str
        The method in a line.
    source : str
        The paper.
    learns : str
        What is fitted on images before it can run.
    build : callable
        ``build(config, progress=None)`` returns the `Method`.
    weights : str
        Of `loopclosure.weights.WEIGHTS`, those of its own network; empty where there is none, or the user brings it.
    numbers : int or None
        Length of a descriptor at the default settings; None where it depends on the user's network.
    """

    summary: str
    source: str
    learns: str
    build: Callable[..., Method]
    weights: str = ""
    numbers: int | None = None


def _kl_netvlad(config: Config, progress: ProgressCallback | None = None) -> Method:
    from loopclosure.methods.kl_netvlad import KLNetVLAD

    return KLNetVLAD(config, progress=progress)


def _netvlad(config: Config, progress: ProgressCallback | None = None) -> Method:
    from loopclosure.methods.netvlad import netvlad

    return netvlad(config, progress=progress)


def _seqslam(config: Config, progress: ProgressCallback | None = None) -> Method:  # noqa: ARG001  (nothing to fetch)
    from loopclosure.methods.seqslam import SeqSLAM

    return SeqSLAM(config)


def _fabmap(config: Config, progress: ProgressCallback | None = None) -> Method:  # noqa: ARG001  (nothing to fetch)
    from loopclosure.methods.fabmap import FabMapMethod

    return FabMapMethod(config)


def _bow(config: Config, progress: ProgressCallback | None = None) -> Method:  # noqa: ARG001  (nothing to fetch)
    from loopclosure.methods.bag_of_words import BagOfWordsMethod

    return BagOfWordsMethod(config)


def _bow_incremental(config: Config, progress: ProgressCallback | None = None) -> Method:  # noqa: ARG001
    from loopclosure.methods.bag_of_words import IncrementalBagOfWords

    return IncrementalBagOfWords(config)


def _cnn(config: Config, progress: ProgressCallback | None = None) -> Method:
    from loopclosure.methods.cnn import cnn

    return cnn(config, progress=progress)


def _cnn_ae(config: Config, progress: ProgressCallback | None = None) -> Method:
    from loopclosure.methods.cnn import cnn_ae

    return cnn_ae(config, progress=progress)


def _cnn_pca(config: Config, progress: ProgressCallback | None = None) -> Method:
    from loopclosure.methods.cnn import cnn_pca

    return cnn_pca(config, progress=progress)


def _faster_rcnn(config: Config, progress: ProgressCallback | None = None) -> Method:
    from loopclosure.methods.faster_rcnn import faster_rcnn

    return faster_rcnn(config, progress=progress)


def _onnx(config: Config, progress: ProgressCallback | None = None) -> Method:  # noqa: ARG001  (nothing to fetch)
    from loopclosure.methods.onnx import onnx

    return onnx(config)


_JIANG = "Jiang, Zhou, Sun, Appl. Sci. 2024, 14(1), 8"
_ARANDJELOVIC = "Arandjelovic et al., CVPR 2016; Jiang et al. 2024, Table 6"

METHODS: dict[str, MethodEntry] = {
    "kl-netvlad": MethodEntry(
        "feature maps of any backbone, compressed by the Karhunen-Loeve transform, as NetVLAD descriptors",
        _JIANG,
        "KL basis and clusters, on the drive itself or by `fit`",
        _kl_netvlad,
        weights="efficientnet-lite0",
        numbers=128,
    ),
    "netvlad-resnet152": MethodEntry(
        "conv5 of ResNet-152 as a NetVLAD descriptor, uncompressed",
        _ARANDJELOVIC,
        "clusters",
        _netvlad,
        weights="resnet152-imagenet1k-v2",
        numbers=64 * 2048,
    ),
    "netvlad-vgg16": MethodEntry(
        "conv5 of VGG-16 as a NetVLAD descriptor, uncompressed",
        _ARANDJELOVIC,
        "clusters",
        _netvlad,
        weights="vgg16-imagenet1k-v1",
        numbers=64 * 512,
    ),
    "seqslam": MethodEntry(
        "grey thumbnails compared by correlation, trajectories of several speeds",
        "Milford & Wyeth, ICRA 2012",
        "nothing",
        _seqslam,
        numbers=64 * 32,
    ),
    "fabmap": MethodEntry(
        "words of RootSIFT features, how likely they are at each place and at a new one",
        "Cummins & Newman, IJRR 27(6), 2008; IJRR 30(9), 2011",
        "vocabulary, Chow-Liu tree and samples of places, best by `fit` on other images",
        _fabmap,
    ),
    "bow": MethodEntry(
        "words of RootSIFT or ORB features by tf-idf",
        "Galvez-Lopez & Tardos, IEEE Trans. Robotics 28(5), 2012",
        "vocabulary tree, best by `fit` on other images",
        _bow,
    ),
    "bow-incremental": MethodEntry(
        "words of RootSIFT or ORB features that appear as the drive goes on",
        "Angeli et al., IEEE Trans. Robotics 24(5), 2008",
        "nothing before the drive",
        _bow_incremental,
    ),
    "faster-rcnn": MethodEntry(
        "features of the regions that look like objects, their mean and maximum",
        "Ren et al. 2015, arXiv:1506.01497; Jiang et al. 2024, Table 6",
        "the mean of the first frames",
        _faster_rcnn,
        weights="fasterrcnn-coco",
        numbers=2 * 256,
    ),
    "cnn": MethodEntry(
        "feature maps averaged over 3 x 3 cells, by cosine",
        "Jiang et al. 2024, Table 1",
        "the mean of the first frames",
        _cnn,
        weights="efficientnet-lite0",
        numbers=9 * 112,
    ),
    "cnn-ae": MethodEntry(
        "the cells of `cnn` through the bottleneck of an autoencoder",
        "Hinton & Salakhutdinov, Science 313, 2006; Jiang et al. 2024, Table 1",
        "autoencoder",
        _cnn_ae,
        weights="efficientnet-lite0",
        numbers=9 * 45,
    ),
    "cnn-pca": MethodEntry(
        "the cells of `cnn` by their principal components",
        "Jiang et al. 2024, Table 1",
        "principal components, fewer than frames to fit on",
        _cnn_pca,
        weights="efficientnet-lite0",
        numbers=403,
    ),
    "onnx": MethodEntry(
        "the vector that the user's own network makes of an image, by cosine",
        "yours",
        "the mean of the first frames",
        _onnx,
    ),
}


def build_method(config: Config, *, progress: ProgressCallback | None = None) -> Method:
    """Build the method that `config.method` names.

    Raises
    ------
    ConfigError
        For an unknown name, with the nearest known one.
    """
    if config.method not in METHODS:
        raise ConfigError(
            f"unknown method '{config.method}'{did_you_mean(config.method, METHODS)}; known: {', '.join(METHODS)}"
        )
    return METHODS[config.method].build(config, progress)


__all__ = ["METHODS", "Method", "MethodEntry", "PlaceMap", "Scores", "build_method"]
