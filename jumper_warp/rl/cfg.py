"""Settings of a training (this module does not import PyTorch)."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from jumper_warp.utils import checks
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.threads import checked_threads

MOST_ITERATIONS = 10**9  # Largest number of iterations of a training
PPO_BOUNDS = {
    "num_steps": (1, 10_000, ""), "epochs": (1, 1000, ""), "minibatches": (1, 100_000, ""), "lr": (1.0e-12, 10.0, ""),
    "max_grad_norm": (1.0e-6, 1.0e12, ""), "init_std": (1.0e-4, 100.0, ""), "clip": (1.0e-6, 100.0, ""),
    "reward_scale": (1.0e-6, 1.0e6, ""), "value_coef": (0.0, 1.0e6, ""), "entropy_coef": (0.0, 1.0e6, ""),
    "final_entropy_coef": (0.0, 1.0e6, ""), "desired_kl": (0.0, 100.0, "nat"), "final_desired_kl": (0.0, 100.0, "nat"),
    "gamma": (0.0, 1.0, ""), "lam": (0.0, 1.0, ""), "max_lr": (0.0, 10.0, ""),
}  # fmt: skip
"""Smallest and largest value of settings of PPO, and unit."""
LATEST, LATEST_OR_NEW = "latest", "latest-or-new"  # Values of `TrainCfg.resume` that are not paths
SESSION = ("device", "threads", "log_root", "resume", "init_policy", "tensorboard", "wandb")
"""Settings of `TrainCfg` that are not restored when a run is resumed."""


@dataclass(frozen=True)
class PpoCfg:
    """Settings of proximal policy optimisation (PPO); a task can have its own defaults (`registry.TASKS`)."""

    num_steps: int = 32
    """Policy steps of each world per iteration."""
    epochs: int = 5
    """Passes over the batch of num_steps · num_envs samples per iteration."""
    minibatches: int = 8
    """Optimiser steps per pass. Their number divides num_steps · num_envs."""
    gamma: float = 0.985
    """Discount per policy step."""
    lam: float = 0.95
    """λ of generalised advantage estimation (GAE)."""
    clip: float = 0.2
    """Clipping range of the probability ratio, and of the value in standard deviations of the return."""
    value_coef: float = 2.0
    """Weight of the value loss in the total loss."""
    asymmetric_critic: bool = True
    """Whether the critic also observes privileged simulation states, instead of the actor's observation only."""
    clip_value: bool = True
    """Whether the value loss is clipped."""
    normalise_value: bool = True
    """Whether the critic predicts returns normalised by their running mean and standard deviation."""
    entropy_coef: float = 0.0015
    """Weight of the entropy bonus in the loss of PPO."""
    final_entropy_coef: float | None = None
    """Entropy coefficient at the end, approached linearly in the second half of a training (default: constant)."""
    lr: float = 1.0e-3
    """Initial learning rate of Adam."""
    min_lr: float = 1.0e-6
    """Lower bound of the adaptive learning rate."""
    max_lr: float = 1.0e-2
    """Upper bound of the adaptive learning rate."""
    desired_kl: float = 0.01
    """Target KL divergence per update [nat]. Above twice this value the learning rate falls, below half of it the
    learning rate rises. 0: fixed learning rate."""
    final_desired_kl: float = 0.002
    """Target KL divergence at the end [nat], at most `desired_kl`, approached linearly in the second half."""
    max_grad_norm: float = 1.0
    """Norm to which the gradients of actor and critic are each clipped."""
    init_std: float = 1.0
    """Initial standard deviation of the exploration noise, in units of the action."""
    reward_scale: float = 0.6
    """Factor on every reward."""
    hidden: tuple[int, ...] = (256, 128, 128)
    """Widths of the hidden layers of actor and critic."""
    activation: str = "elu"
    """Activation of the hidden layers: elu, relu or tanh."""
    symmetry: Literal["off", "actor", "both"] = "off"
    """Symmetry of the policy. With `actor`, observations that are mirrored left to right give mirrored actions for any
    weights, with `both` also those mirrored front to back; the task must define these mirror images."""
    tf32: bool = True
    """Whether matrix products on a GPU may use TF32, which rounds their factors to 10 mantissa bits."""
    graphs: bool = True
    """Whether to capture an iteration as CUDA graphs and replay them; no effect on a CPU."""
    fused: bool = True
    """Whether to act and update with fused bfloat16 kernels on GPUs that can (`jumper_warp.rl.fused`); other networks,
    older GPUs and CPUs use PyTorch."""

    def __post_init__(self) -> None:
        """Raise InputError (a ValueError) if a setting of PPO is of another type or out of range."""
        object.__setattr__(self, "hidden", tuple(self.hidden) if isinstance(self.hidden, list) else self.hidden)
        checks.check_types("ppo", self)
        checks.check_bounds("ppo", self, PPO_BOUNDS)
        if not 0.0 < self.min_lr <= self.lr <= self.max_lr:
            raise InputError(f"need 0 < min_lr <= lr <= max_lr, got {self.min_lr}, {self.lr}, {self.max_lr}")
        checks.check_network(self.hidden, self.activation)

    def batch_size(self, num_envs: int) -> int:
        """Return the number of samples that an iteration collects in num_envs worlds, num_steps · num_envs.

        Raises InputError: there is only one sample, or the minibatches do not divide the samples.
        """
        size = self.num_steps * num_envs
        if size < 2:
            raise InputError(f"an iteration needs at least 2 samples, got {self.num_steps} x {num_envs}")
        if size % self.minibatches:
            raise InputError(f"{self.minibatches} minibatches do not divide {self.num_steps} x {num_envs} samples")
        return size


@dataclass(frozen=True)
class TrainCfg:
    """Settings of a policy's training: task, length, files, trainer and its hyperparameters."""

    task: str = "vertical-jump"
    """Name of the task, also of the folder of its runs."""
    num_envs: int = 8192
    """Number of simulated robots (worlds), over all processes."""
    max_iterations: int = 2800
    """Number of iterations, including those before a resume."""
    max_seconds: float = 0.0
    """Limit of the training time [s], over all resumes; 0: none. Time is counted from the end of a process's first
    iteration, without building and compilation, but with logging and saving."""
    seed: int = 1
    """Random seed of weights, noise and worlds. Range 0 to 2^31 - 1; each process derives a different seed from it."""
    seeds: tuple[int, ...] = ()
    """Seeds of several trainings with these settings, side by side on one device, each with `num_envs` worlds (default:
    one training with `seed`). Under torchrun every GPU trains some of the seeds."""
    device: str | None = None
    """PyTorch device, such as cuda:0 or cpu (default: a GPU if there is one)."""
    threads: int | None = None
    """CPU threads of each process (default: its part of the cores). Its worlds share them. PyTorch uses as many
    (default: half the cores but at least two; OMP_NUM_THREADS overrides); their number changes the last digits of
    results."""
    log_root: Path = Path("logs")
    """Folder of all runs. A run is written to log_root/<task>/<start time>."""
    run_name: str | None = None
    """Name of the run, which follows the time in its folder's name, and is shown in titles and lists."""
    tags: tuple[str, ...] = ()
    """Words that describe the run, for `jumper list runs` and Weights & Biases."""
    log_interval: int = 10
    """Number of iterations between two logged iterations; those with a checkpoint are logged too."""
    save_interval: int = 100
    """Number of iterations between two checkpoints."""
    max_checkpoints: int = 3
    """Number of newest checkpoints to keep; the best checkpoint is never deleted."""
    best_metric: str = "Metrics/success"
    """Logged metric whose mean since the checkpoint before selects the best one; higher is better. Checkpoints saved
    while most worlds are below the last curriculum level are left out."""
    resume: str | None = None
    """Run to continue: its folder, a checkpoint, latest or latest-or-new. `latest` is the task's latest run with a
    checkpoint; `latest-or-new` starts a new run if there is none. `jumper train` uses the saved settings of that run
    except device, threads, log_root, tensorboard and wandb; flags override them."""
    init_policy: str | None = None
    """Policy, run or checkpoint to start from. It is a policy's name or folder, a run's folder (its best checkpoint) or
    a checkpoint. The training starts with its actor weights and observation statistics; critic, optimiser and noise
    are new."""
    stop_on_nan: bool = False
    """Whether the training ends with exit status 1, after a checkpoint, when a term is not finite for the first time.
    Without it the value counts as 0, one line names it, and the state of its world is saved."""
    tensorboard: bool = True
    """Whether to write TensorBoard events."""
    wandb: str | None = None
    """Project of Weights & Biases to which metrics are uploaded (default: none); WANDB_MODE=offline keeps them here."""
    ppo: PpoCfg = field(default_factory=PpoCfg)
    """Hyperparameters of PPO."""

    def __post_init__(self) -> None:
        """Raise InputError (a ValueError) if a setting of the training is out of range."""
        object.__setattr__(self, "log_root", Path(self.log_root))
        checks.check_types("training:", self)
        object.__setattr__(self, "num_envs", checks.check_count("num_envs", self.num_envs))
        for name in ("max_iterations", "log_interval", "save_interval", "max_checkpoints"):
            object.__setattr__(self, name, checks.check_count(name, getattr(self, name), MOST_ITERATIONS))
        checks.check_not_negative("max_seconds", self.max_seconds)
        checked_threads(self.threads)
        object.__setattr__(self, "seed", checks.check_seed(self.seed))
        object.__setattr__(self, "seeds", tuple(checks.check_seed(seed) for seed in self.seeds))
        if len(set(self.seeds)) < len(self.seeds):
            raise InputError(f"seeds must be distinct, got {self.seeds}")
        for name in (self.task, self.run_name, *self.tags):
            if name is not None and not checks.NAME.fullmatch(name):
                allowed = "letters, digits, _ . - and spaces"
                raise InputError(f"task, run_name and tags may contain {allowed}, got {name!r:.60}")
        for name in ("resume", "init_policy"):
            if getattr(self, name) == "":
                raise InputError(f"{name} is empty: pass None to begin without it")
        if self.resume and self.resume != LATEST_OR_NEW and self.init_policy:
            raise InputError("pass resume, to continue a training, or init_policy, to begin one, not both")

    def check_processes(self, count: int) -> None:
        """Raise InputError unless number of worlds and batch size are valid for a number of processes."""
        if self.seeds:
            if len(self.seeds) < count:
                raise InputError(f"{count} processes need as many seeds, got {len(self.seeds)}")
            count = 1  # each process trains its seeds alone
        if self.num_envs % count:
            raise InputError(f"num_envs {self.num_envs} is not divisible by {count} processes")
        self.ppo.batch_size(self.num_envs // count)
