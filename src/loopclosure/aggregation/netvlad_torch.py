"""NetVLAD as a torch layer, for training; the same arithmetic as `netvlad.NetVLAD`."""

from __future__ import annotations

import torch
from torch import nn
from torch.nn import functional

from loopclosure.aggregation.netvlad import NetVLAD


class NetVLADLayer(nn.Module):  # type: ignore[misc]
    """Trainable twin of a fitted `NetVLAD`: centres, weights and bias are free parameters.

    Parameters
    ----------
    fitted : NetVLAD
        Where the parameters start.
    """

    def __init__(self, fitted: NetVLAD) -> None:
        super().__init__()
        for name, array in fitted.to_arrays().items():
            self.register_parameter(name, nn.Parameter(torch.from_numpy(array.copy())))

    def forward(self, maps: torch.Tensor) -> torch.Tensor:
        """Describe each image.

        Parameters
        ----------
        maps : Tensor of float, shape (n, D, h, w)
            Feature maps in torch's own layout.

        Returns
        -------
        Tensor of float, shape (n, K * D)
            Unit rows.
        """
        local = functional.normalize(maps.flatten(2).transpose(1, 2), dim=-1)
        assignment = torch.softmax(local @ self.weights.T + self.bias, dim=-1)
        residuals = assignment.transpose(1, 2) @ local - assignment.sum(1)[:, :, None] * self.centres
        return functional.normalize(functional.normalize(residuals, dim=-1).flatten(1), dim=-1)

    def to_numpy(self) -> NetVLAD:
        """Return the layer as it now stands, for running without torch."""
        return NetVLAD.from_arrays({name: value.detach().cpu().numpy() for name, value in self.named_parameters()})
