"""Write a global descriptor as the ONNX file that `--method onnx` takes: the embedded network and GeM pooling.

python examples/onnx_descriptor.py --out descriptor.onnx
loopclosure detect drive/images --method onnx --set onnx.path=descriptor.onnx --out run

Another network comes in the same way: export it with the images as its one input and a vector as its output, and say
in the JSON beside it how large the images are and how they are scaled.
"""

import argparse
from pathlib import Path

import torch
from torch.onnx.utils import export  # needs nothing beside torch, as `torch.onnx.export` does

from loopclosure.features.backbones import Backbone
from loopclosure.features.onnx_network import OnnxHeader

OPSET = 17


class GeM(torch.nn.Module):
    """Generalised mean of each channel over all positions (Radenovic et al., PAMI 41(7), 2019, eq. 1)."""

    def __init__(self, network: torch.nn.Module, power: float = 3.0) -> None:
        super().__init__()
        self.network, self.power = network, power

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        (maps,) = self.network(images)
        return maps.clamp(min=1e-6).pow(self.power).mean(dim=(2, 3)).pow(1 / self.power)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("descriptor.onnx"))
    parser.add_argument("--layer", default="s16")
    options = parser.parse_args()
    backbone = Backbone("efficientnet-lite0", options.layer)
    prepare = backbone.preprocessing
    export(
        GeM(backbone.module).eval(),
        (torch.zeros(1, 3, *prepare.size),),
        str(options.out),
        input_names=["images"],
        output_names=["descriptor"],
        dynamic_axes={"images": {0: "n"}, "descriptor": {0: "n"}},
        opset_version=OPSET,
    )
    header = OnnxHeader(
        height=prepare.height, width=prepare.width, mean=prepare.mean, std=prepare.std, output="descriptor"
    )
    options.out.with_suffix(".json").write_text(header.model_dump_json(indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
