"""Plot the learning curves of the paper's recipe from docs/results/paper; nothing is trained.

    python -m docs.paper_curves

Lines are means over the seeds, bands their ranges.
"""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
from PIL import Image

from experiments.support.policy_results import METRICS, RESULTS
from jumper_warp.viz.plots import figure

TASKS = {
    "vertical-jump-paper": ("success, 0.5–1.2 m", 0.91),
    "horizontal-jump-paper": ("success, 0.3–1.5 m", 0.97),
    "velocity-paper": ("RMSE ahead [m/s]", None),
}
"""Label of the curves, and the paper's value in simulation, by task; None: the paper measured its robot only."""
ARMS = ("full", "no_initialisation", "no_estimates", "no_curriculum")


def main(out: Path = RESULTS / "paper/curves.webp") -> Path:
    """Plot the curves, and return the path of the picture."""
    png = out.with_suffix(".png")
    with figure(png, 1, len(TASKS), figsize=(13.0, 4.4), title="Learning curves of the paper's tasks") as axes:
        for axis, (task, (label, paper)) in zip(axes, TASKS.items(), strict=True):
            for i, arm in enumerate(ARMS):
                files = sorted((RESULTS / "paper" / task).glob(f"{arm}_*/{METRICS}"))
                runs = [json.loads(file.read_text())["metrics"] for file in files]
                if not runs:
                    continue
                curves = [(run["curve_steps"]["value"], run["curve_values"]["value"]) for run in runs]
                common = min((curve[0] for curve in curves), key=len)  # one seed of walking has fewer tests
                values = np.array([np.interp(common, *curve) for curve in curves])
                steps = np.array(common) / 1e6
                axis.fill_between(steps, values.min(axis=0), values.max(axis=0), color=f"C{i}", alpha=0.12, linewidth=0)
                axis.plot(steps, values.mean(axis=0), color=f"C{i}", label=arm.replace("_", " "))
            if paper is not None:
                axis.axhline(paper, color="black", linestyle=":", label="the paper, simulation")
            axis.set(title=task, xlabel="policy steps [million]", ylabel=label, ylim=(0.0, None))
    image = io.BytesIO()
    Image.open(png).save(image, "webp", quality=88, method=6)
    out.write_bytes(image.getvalue())
    png.unlink()
    print(out)
    return out


if __name__ == "__main__":
    main()
