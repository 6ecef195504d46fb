"""Pages of the Python API, one for each area with autodoc of its modules, and conversion of docstrings for autodoc."""

from __future__ import annotations

import importlib
from typing import Any

from sphinx.application import Sphinx

from jumper_warp.cli.flags import field_docs
from plain_text import to_rst

AREAS: dict[str, tuple[str, tuple[str, ...]]] = {
    "environments": ("Environments", (
        "envs.env", "envs.vec_env", "envs.skill", "envs.state", "envs.parameters", "envs.camera", "envs.gymnasium",
        "gym", "envs.rsl_rl", "envs.sb3",
    )),
    "simulation": ("Simulation and solvers", (
        "sim.simulation", "sim.solver", "sim.mujoco", "sim.dynamics", "sim.model_parts",
    )),
    "robot": ("Robot", (
        "robot.model", "robot.description", "robot.motors", "robot.overlay", "robot.bounds", "robot.grounds",
        "robot.terrain", "robot.gravity", "robot.export",
    )),
    "tasks": ("Tasks", (
        "registry", "tasks.evaluation", "tasks.jump.cfg", "tasks.jump.evaluation", "tasks.jump.vertical",
        "tasks.jump.horizontal", "tasks.jump.mars", "tasks.velocity.cfg", "tasks.velocity.flat",
        "tasks.velocity.rough", "tasks.attitude.cfg", "tasks.attitude.flight", "tasks.interface", "tasks.switching",
        "tasks.observations", "tasks.mirror", "tasks.saving",
    )),
    "gradients": ("Gradients", (
        "diff.rollout", "diff.torch_rollout", "envs.gradients", "envs.gradient_check",
    )),
    "training": ("Training", (
        "rl.cfg", "rl.runner", "rl.learner", "rl.torch.ppo", "rl.networks", "rl.checkpoint", "rl.run_folder",
        "rl.logger", "rl.mirror", "rl.distributed",
    )),
    "policies": ("Policies", (
        "policies.policy", "policies.warm_start", "policies.spec", "policies.catalog", "policies.onnx", "deploy.policy",
    )),
    "evaluation": ("Evaluation", (
        "evaluation.run", "evaluation.conditions", "evaluation.skills",
        "evaluation.log", "evaluation.commands", "evaluation.suites",
        "evaluation.sweeps", "evaluation.episodes", "evaluation.jump_metrics",
        "evaluation.velocities", "evaluation.attitude", "evaluation.jumps", "evaluation.courses",
        "evaluation.scripts", "evaluation.recorder", "evaluation.limits", "evaluation.finetuning",
        "evaluation.finetuning_cfg",
    )),
    "identification": ("Identification", (
        "identification.identify", "identification.parameters", "identification.recording",
        "identification.motions", "identification.excitation",
        "identification.residuals", "identification.least_squares", "identification.initial_states",
        "identification.uncertainty", "identification.results", "identification.report", "identification.replay",
    )),
    "trajectory": ("Plans and fine-tuning", (
        "trajectory.plan", "trajectory.gauss_newton", "evaluation.predictive_control",
    )),
    "viz": ("Recordings and pictures", (
        "viz.recorder", "viz.recording", "viz.film", "viz.picture", "viz.plots", "viz.rerun", "viz.rerun_server",
        "viz.live_recording", "viz.renderer", "viz.viser", "viz.scene", "viz.props", "viz.style",
    )),
    "utils": ("Errors and output", (
        "utils.errors", "utils.metrics", "utils.output", "utils.runtime", "utils.streams",
    )),
}  # fmt: skip
"""Title and modules of each page, by its file name."""


def module_text(module: str) -> str:
    """Return the reStructuredText that documents a module of `jumper_warp`."""
    name = f"jumper_warp.{module}"
    title = f"``{name}``"
    return "\n".join([title, "-" * len(title), "", f".. automodule:: {name}", "   :members:", ""])


def api_pages() -> dict[str, str]:
    """Return the pages of the Python API in reStructuredText by file name."""
    pages = {}
    for name, (title, modules) in AREAS.items():
        parts = [title, "=" * len(title), "", *map(module_text, modules)]
        pages[f"{name}.rst"] = "\n".join(parts)
    return pages


def api_table() -> str:
    """Return the table of all API pages and their modules, and the table of contents, in Markdown."""
    rows = [f"| [{title}](../reference/api/{name}.rst) | {', '.join(f'`{module}`' for module in modules)} |"
            for name, (title, modules) in AREAS.items()]  # fmt: skip
    contents = ["```{toctree}", ":hidden:", *(f"api/{name}" for name in AREAS), "```"]
    return "\n".join(["| Page | Modules of `jumper_warp` |", "|---|---|", *rows, "", *contents]) + "\n"


def plain_docstring(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Convert the lines of a docstring to reStructuredText in place; a field without a docstring gets its comment."""
    if what == "attribute" and (not lines or lines[0].startswith("Alias for field number")):
        lines[:] = [_field_comment(name)]
    lines[:] = to_rst("\n".join(lines)).splitlines()


def _field_comment(name: str) -> str:
    """Return the comment after a field of a class by its full name; empty if there is none."""
    owner, _, field = name.rpartition(".")
    module, _, kind = owner.rpartition(".")
    try:
        return field_docs(getattr(importlib.import_module(module), kind)).get(field, "")
    except (ImportError, AttributeError):
        return ""


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the conversion of docstrings with Sphinx."""
    app.connect("autodoc-process-docstring", plain_docstring)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
