"""A bundle: a fitted model together with its network, which runs where torch is not installed.

A model holds what was learned and names the network; the network itself is rebuilt by torch. A bundle is a model folder
whose network lies beside it in OpenVINO's format and as ONNX (`loopclosure.features.exported`).
"""

from __future__ import annotations

import os
import tempfile
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from loopclosure import store
from loopclosure.detect import LoopDetector
from loopclosure.errors import ConfigError, ModelError
from loopclosure.features.exported import ExportedCard, ExportedNetwork, Runtime
from loopclosure.features.networks import MapNetwork
from loopclosure.features.onnx_network import OnnxHeader
from loopclosure.features.openvino_runtime import converted, import_openvino, least_cosine, made_images, precision_of
from loopclosure.methods.kl_netvlad import KLNetVLAD
from loopclosure.traverse import describe_traverse
from loopclosure.weights import Progress, file_sha256

if TYPE_CHECKING:
    from loopclosure.features.backbones import Backbone

LEAST_COSINE = 0.999
"""Of descriptors by an exported network to those by torch in single precision; below it nothing is written."""

OPSET = 17
_OUTPUT = "maps"


def export_model(
    model: str | os.PathLike[str], out: str | os.PathLike[str], *, progress: Progress | None = None
) -> dict[str, Any]:
    """Write a bundle of a model, for ``LoopDetector(model=out)`` without torch.

    Both forms of the network must describe some made images as torch does in single precision; otherwise nothing is
    written.

    Parameters
    ----------
    model : path
        Folder that ``loopclosure fit`` or ``loopclosure train`` wrote, or the folder ``model`` of a run.
    out : path
        Folder of the bundle; made if it is absent, its files are replaced.
    progress : callable, optional
        ``progress(done, total)`` in bytes, where weights have to be downloaded.

    Returns
    -------
    dict
        What ``loopclosure export --json`` prints: ``bundle``, ``precision`` of OpenVINO, and ``cosines``, the smallest
        of a descriptor by runtime.

    Raises
    ------
    ConfigError
        If the model is of a method without such a network, or a package that exporting needs is not installed.
    ModelError
        If the model cannot be used, is a bundle already, or an exported network describes images differently.
    """
    _check_packages()
    header, arrays = store.load_arrays(model, kind="model")
    if os.path.basename(store.saved_config(header, model).features.weights) == store.EXPORTED:
        raise ModelError(f"{model} is a bundle already; export the model that it was made from")
    detector = LoopDetector(model=model, progress=progress)
    method, config = detector.method, detector.config
    if not isinstance(method, KLNetVLAD) or config.features.backbone == "onnx":
        raise ConfigError(
            f"a bundle holds a network in front of KL and NetVLAD, which torch reads; {model} is of the method "
            f"{config.method} with the backbone {config.features.backbone}"
        )
    target = Path(out)
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{target.name}-", dir=target.parent) as part:
        precision, cosines = _write_network(method, Path(part))
        exported = config.with_settings({"features.weights": store.EXPORTED, "features.backend": "auto"})
        store.save_arrays(part, kind="model", header=header | {"config": exported.model_dump()}, arrays=arrays)
        target.mkdir(exist_ok=True)
        for name in (*store.EXPORTED_FILES, store.EXPORTED, store.ARRAYS, store.HEADER):
            os.replace(Path(part) / name, target / name)
    return {"bundle": str(out), "precision": precision, "cosines": cosines}


def _check_packages() -> None:
    try:
        import onnx  # noqa: F401  (torch writes by it)
        import onnxruntime  # noqa: F401  (checks what was written)
    except ImportError as error:
        raise ConfigError(f"exporting wants {error.name}: pip install 'loopclosure[export]'") from None


def _write_network(method: KLNetVLAD, folder: Path) -> tuple[str, dict[str, float]]:
    """Write the network of a method, and return what OpenVINO computes it in and how well it agrees with torch."""
    from loopclosure.features.backbones import Backbone

    features = method.config.features
    backbone = Backbone(
        features.backbone,
        features.layer,
        weights=features.weights,
        height=features.height,
        width=features.width,
    )
    precision = _write_openvino(backbone, folder / "network.xml")
    _write_onnx(backbone, folder / "network.onnx")
    images = made_images(backbone.preprocessing)
    wanted = _descriptors(method, backbone, images)

    def cosine(runtime: Runtime) -> float:
        return least_cosine(_descriptors(method, ExportedNetwork(card, runtime=runtime), images), wanted)

    card = _write_card(backbone, folder, precision)
    cosines = {"openvino": cosine("openvino"), "onnx": cosine("onnx")}
    if precision != "f32" and cosines["openvino"] < LEAST_COSINE:
        precision = "f32"
        _write_card(backbone, folder, precision)
        cosines["openvino"] = cosine("openvino")
    for runtime, found in cosines.items():
        if found < LEAST_COSINE:
            raise ModelError(
                f"by {runtime} descriptors agree with torch to a cosine of {found:.5f}, wanted {LEAST_COSINE}; "
                "nothing was written"
            )
    return precision, cosines


def _write_openvino(backbone: Backbone, file: Path) -> str:
    ov = import_openvino()
    model = converted(ov.Core(), backbone)
    ov.save_model(model, file, compress_to_fp16=False)
    return precision_of(model)


def _write_onnx(backbone: Backbone, file: Path) -> None:
    import torch
    from torch.onnx.utils import export  # `torch.onnx.export` needs further packages since it traces with Dynamo

    prepare = backbone.preprocessing
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what the exporter does not fold is its own affair
        export(
            backbone.module,
            (torch.zeros(1, 3, *prepare.size),),
            str(file),
            input_names=["images"],
            output_names=[_OUTPUT],
            dynamic_axes={"images": {0: "n"}, _OUTPUT: {0: "n"}},
            opset_version=OPSET,
        )
    header = OnnxHeader(
        height=prepare.height, width=prepare.width, mean=prepare.mean, std=prepare.std, output=_OUTPUT, layout="nchw"
    )
    file.with_suffix(".json").write_text(header.model_dump_json(indent=2) + "\n", encoding="utf-8")


def _write_card(backbone: Backbone, folder: Path, precision: str) -> Path:
    prepare = backbone.preprocessing
    card = ExportedCard(
        backbone=backbone.name,
        layer=backbone.layers[0],
        height=prepare.height,
        width=prepare.width,
        mean=prepare.mean,
        std=prepare.std,
        weights=backbone.weights_name,
        weights_sha256=backbone.weights_sha256,
        precision=precision,
        sha256={name: file_sha256(folder / name) for name in store.EXPORTED_FILES},
    )
    file = folder / store.EXPORTED
    file.write_text(card.model_dump_json(indent=2) + "\n", encoding="utf-8")
    return file


def _descriptors(method: KLNetVLAD, network: MapNetwork, images: Sequence[np.ndarray]) -> np.ndarray:
    """Return what a map would keep of images, one row each; their feature maps where nothing was fitted yet."""
    maps = network.maps(images)[method.config.features.layer]
    if not method.fitted:
        return maps
    return np.stack(describe_traverse(method, method.config, [method.describe([one]) for one in maps])[0])
