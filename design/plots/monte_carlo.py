"""The picture of a Monte Carlo: the distribution of the merit, and what each tolerance contributes."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from ...core.plotting import BLUE, GREY, RED, new_figure, styled
from ..optimize.monte_carlo import MonteCarlo

#: So many tolerances are drawn, the largest contributions first.
_BARS = 20
_TITLES = {"wavefront": "rms wavefront", "spots": "rms spot radius"}


def monte_carlo_figure(result: MonteCarlo) -> Figure:
    """Draw the cumulative distribution of the merit and the contributions, largest first."""
    finite = np.sort(result.merit[np.isfinite(result.merit)])
    highest = float(finite.max(initial=result.nominal))
    unit, scale = ("nm", 1e9) if highest < 1e-6 else ("µm", 1e6)
    shown = np.argsort(result.contribution)[::-1][:_BARS]
    with styled():
        figure = new_figure(9.0, max(3.4, 1.2 + 0.19 * len(shown)))
        left, right = figure.subplots(1, 2)
        share = 100.0 * np.arange(1, len(finite) + 1) / len(result.merit)
        left.step(finite * scale, share, where="post", color=BLUE)
        left.axvline(result.nominal * scale, color=GREY, linestyle=(0, (4, 2)), linewidth=0.9, label="as designed")
        for percent in (50, 95):
            value = result.at_most(percent / 100.0) * scale
            if np.isfinite(value):
                left.plot(value, percent, "o", color=RED, markersize=4.0)
                left.annotate(
                    f"{percent} %: {value:.4g}", (value, percent), (6, -3), textcoords="offset points", va="top"
                )
        left.set(xlabel=f"{_TITLES[result.merit_name]} [{unit}]", ylabel="telescopes at most there [%]", ylim=(0, 103))
        left.margins(x=0.12)
        left.legend(loc="lower right")
        left.set_title(f"{len(result.merit)} draws, {result.method}")
        right.barh(np.arange(len(shown)), result.contribution[shown] * scale, color=BLUE, height=0.7)
        right.set_yticks(np.arange(len(shown)), [result.tolerances[i].name for i in shown])
        right.invert_yaxis()
        right.set_xlabel(f"contribution, added in squares [{unit}]")
        compensated = f", compensated by {', '.join(result.compensators)}" if result.compensators else ""
        more = f" (largest {_BARS} of {len(result.contribution)})" if len(result.contribution) > _BARS else ""
        right.set_title(f"each tolerance alone{more}")
        figure.suptitle(f"{result.telescope}: within tolerances{compensated}", fontsize=11)
        return figure
