"""Coverage of the image and the range together, as maps."""

from __future__ import annotations

from rgbd_calib.report.plots import Figure
from rgbd_calib.views.range_coverage import RangeCoverage

_COUNTS = [[0, "#f3d9d3"], [0.001, "#eef3f7"], [1, "#4f86b8"]]


def figure(own: RangeCoverage) -> Figure:
    """Maps of one image, near to far, in one row."""
    top = max(int(own.counts.max()), 1)
    traces, notes = [], []
    layout: Figure = {"height": 150, "margin": {"l": 4, "r": 4, "t": 22, "b": 4}, "showlegend": False}
    gap, share = 0.02, 1 / len(own.counts)
    for i, counts in enumerate(own.counts):
        n = "" if i == 0 else str(i + 1)
        traces.append(
            {
                "type": "heatmap",
                "z": counts.tolist(),
                "text": counts.tolist(),
                "texttemplate": "%{text}",
                "hovertemplate": "%{z} views<extra></extra>",
                "colorscale": _COUNTS,
                "zmin": 0,
                "zmax": top,
                "showscale": False,
                "xgap": 2,
                "ygap": 2,
                "xaxis": f"x{n}",
                "yaxis": f"y{n}",
            }
        )
        domain = [i * share + gap / 2, (i + 1) * share - gap / 2]
        layout[f"xaxis{n}"] = {"visible": False, "domain": domain}
        layout[f"yaxis{n}"] = {"visible": False, "autorange": "reversed", "anchor": f"x{n}"}
        notes.append(
            {
                "x": sum(domain) / 2,
                "y": 1,
                "xref": "paper",
                "yref": "paper",
                "xanchor": "center",
                "yanchor": "bottom",
                "text": own.labels[i],
                "font": {"size": 11},
                "showarrow": False,
            }
        )
    return {"data": traces, "layout": layout | {"annotations": notes}}
