"""The spectrum of the Karhunen-Loeve transform (paper 2.2, Fig. 11-12)."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from loopclosure.compression.spectrum import DEGENERATE, energy_share
from loopclosure.report.style import INK, MARKS, MUTED, dress, line_styles, new_figure


def kl_spectrum(energies: np.ndarray, *, kept: int | None = None, lost: float = 0.0) -> Figure:
    """Draw the sorted eigenvalues and the share of the energy that the first ones hold (Eq. 15).

    Parameters
    ----------
    energies : ndarray of float, shape (size,)
        Eigenvalues, largest first, none negative; those that are rounding are left out of the logarithmic panel.
    kept : int, optional
        How many are kept, marked in both panels.
    lost : float
        Energy of eigenvectors that are no longer known.

    Returns
    -------
    matplotlib.figure.Figure
    """
    energies = np.asarray(energies, np.float64)
    number = np.arange(1, len(energies) + 1)
    share = energy_share(energies, lost=lost)
    figure = new_figure(9.6, 3.8)
    left, right = figure.subplots(1, 2)
    line = {"color": line_styles(1)[0]["color"], "linewidth": 2}
    dress(left, title="Eigenvalues", x="component", y="eigenvalue (variance of the features)")
    signal = energies > DEGENERATE * energies.max(initial=0)
    left.semilogy(number[signal], energies[signal], **line)
    dress(right, title="Energy kept, Eq. 15", x="components kept", y="share of the energy (%)")
    right.plot(number, 100 * share, **line)
    right.set_ylim(0, 104)
    for axes in (left, right):
        axes.set_xlim(0.5, max(len(energies), 1) + 0.5)
        if kept is not None:
            axes.axvline(kept, color=MARKS[False].color, linestyle="--", linewidth=1.4)
            axes.axvspan(kept, len(energies) + 0.5, color=MUTED, alpha=0.08, linewidth=0)
    if kept is not None and 0 < kept <= len(share):
        text = f"{kept} of {len(energies)} components\n{100 * share[kept - 1]:.1f} % of the energy"
        right.plot([kept], [100 * share[kept - 1]], marker="o", color=MARKS[False].color)
        late = kept > len(energies) / 2
        place = {"xytext": (-10 if late else 10, -14), "textcoords": "offset points", "ha": "right" if late else "left"}
        right.annotate(text, (kept, 100 * share[kept - 1]), va="top", color=INK, fontsize=9, **place)
    return figure
