"""Settings of a training, which need no PyTorch to be read."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from jumper_warp.utils.checks import check_finite, check_not_negative, check_positive, check_seed
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.threads import checked_threads

ACTIVATIONS = ("elu", "relu", "tanh")
"""Names of activations."""
LATEST, LATEST_OR_NEW = "latest", "latest-or-new"
"""Values of `TrainCfg.resume` that name no path."""


@dataclass(frozen=True)
class PpoCfg:
    """Settings of the algorithm; a task may have others as its defaults (`registry.TASKS`)."""

    num_steps: int = 32
    """Policy steps of each world per iteration."""
    epochs: int = 5
    """Passes over the batch per iteration."""
    minibatches: int = 8
    """Optimiser steps per pass; divides the number of worlds times num_steps."""
    gamma: float = 0.985
    """Discount per policy step."""
    lam: float = 0.95
    """Weight of longer advantage estimates, the λ of GAE."""
    clip: float = 0.2
    """Clipping range of the probability ratio, and of the value in standard deviations of the return."""
    value_coef: float = 2.0
    """Weight of the value loss."""
    asymmetric_critic: bool = True
    """Whether the critic sees what only a simulation knows, instead of the actor's observation."""
    clip_value: bool = True
    """Whether the value loss is clipped."""
    normalise_value: bool = True
    """Whether the critic predicts the return in its running standard deviations."""
    entropy_coef: float = 0.0015
    """Weight of the entropy bonus."""
    final_entropy_coef: float | None = None
    """What entropy_coef becomes, in a straight line over the second half of a training; None: it stays. Much noise
    finds the way, little the finer policy."""
    lr: float = 1.0e-3
    """Adam's step size at the start."""
    min_lr: float = 1.0e-6
    """Its lower bound."""
    max_lr: float = 1.0e-2
    """Its upper bound."""
    desired_kl: float = 0.01
    """The step size falls above twice and rises below half of this divergence; 0 keeps it fixed."""
    final_desired_kl: float = 0.002
    """What desired_kl falls to, in a straight line over the second half of a training; smaller steps, finer policy."""
    max_grad_norm: float = 1.0
    """Gradients of the actor and of the critic are each shortened to this norm."""
    init_std: float = 1.0
    """Exploration noise at the start, in units of the action."""
    reward_scale: float = 0.6
    """Multiplies every reward."""
    hidden: tuple[int, ...] = (256, 128, 128)
    """Widths of the hidden layers."""
    activation: str = "elu"
    """elu, relu or tanh."""
    symmetry: Literal["off", "actor"] = "off"
    """Left-right symmetry of the policy: an actor that answers mirrored observations by mirrored actions whatever the
    weights. For tasks whose observation has a known mirror image."""
    tf32: bool = True
    """Whether matrix products on a GPU may round their factors to 10 mantissa bits."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """What the hidden layers compute in; the last layers, losses and statistics stay in float32."""
    compile: Literal["auto", "on", "off"] = "auto"
    """Whether torch.compile fuses what surrounds the matrix products: auto on a GPU alone, since a CPU gains nothing.
    Needs a C++ compiler; what was compiled is kept in Inductor's cache on disk."""
    graphs: bool = True
    """Whether a GPU replays captured graphs."""

    def __post_init__(self) -> None:
        """Raises ValueError: a setting is out of range."""
        for name in ("num_steps", "epochs", "minibatches", "lr", "max_grad_norm", "init_std", "clip", "reward_scale"):
            check_positive(name, getattr(self, name))
        for name in ("value_coef", "entropy_coef", "desired_kl", "final_desired_kl"):
            check_not_negative(name, getattr(self, name))
        if self.final_entropy_coef is not None:
            check_not_negative("final_entropy_coef", self.final_entropy_coef)
        for name in ("gamma", "lam"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise InputError(f"{name} must be in [0, 1], got {getattr(self, name)}")
        check_finite("max_lr", self.max_lr)
        if not 0.0 < self.min_lr <= self.lr <= self.max_lr:
            raise InputError(f"need 0 < min_lr <= lr <= max_lr, got {self.min_lr}, {self.lr}, {self.max_lr}")
        if self.symmetry not in ("off", "actor"):
            raise InputError(f"symmetry must be off or actor, got {self.symmetry!r:.40}")
        if not self.hidden or min(self.hidden) < 1:
            raise InputError(f"hidden must name at least one positive width, got {self.hidden}")
        if self.activation not in ACTIVATIONS:
            raise InputError(f"activation must be one of {', '.join(ACTIVATIONS)}, got {self.activation}")

    def batch_size(self, num_envs: int) -> int:
        """Return the samples that num_envs worlds give in an iteration.

        Raises ValueError: there is only one, which has no standard deviation, or the minibatches do not divide them.
        """
        size = self.num_steps * num_envs
        if size < 2:
            raise InputError(f"an iteration needs at least 2 samples, got {self.num_steps} x {num_envs}")
        if size % self.minibatches:
            raise InputError(f"{self.minibatches} minibatches do not divide {self.num_steps} x {num_envs} samples")
        return size


@dataclass(frozen=True)
class ShacCfg:
    """Settings of SHAC; steps of a window, discount, lambda, networks, reward scale and noise are those of PPO."""

    lr: float = 1.0e-3
    """Adam's step size of the actor, which falls to a tenth in a straight line."""
    critic_lr: float = 1.0e-3
    """The same of the critic."""
    max_grad_norm: float = 1.0
    """The actor's gradient is shortened to this norm."""
    target_rate: float = 0.2
    """Share by which the target critic follows the critic in an iteration."""
    critic_epochs: int = 8
    """Passes of the critic over a window."""
    critic_minibatches: int = 4
    """Optimiser steps per pass."""
    entropy_coef: float = 0.0
    """Weight of the entropy bonus, per policy step."""

    def __post_init__(self) -> None:
        """Raises ValueError: a setting is out of range."""
        for name in ("lr", "critic_lr", "max_grad_norm", "critic_epochs", "critic_minibatches"):
            check_positive(name, getattr(self, name))
        check_not_negative("entropy_coef", self.entropy_coef)
        if not 0.0 < self.target_rate <= 1.0:
            raise InputError(f"target_rate must be in (0, 1], got {self.target_rate}")


@dataclass(frozen=True)
class TrainCfg:
    """Settings of a training."""

    task: str = "vertical-jump"
    """Name of the task; also the name of the folder of its runs."""
    num_envs: int = 8192
    """Worlds, over all processes."""
    max_iterations: int = 2800
    """Iterations that the run has at its end, those before a resume included."""
    max_seconds: float = 0.0
    """Wall-clock limit [s]; 0: none. What counts is the time from the end of each process's first iteration to the end
    of its last, with logging and saving between, over all resumes: building, compiling and that iteration do not."""
    seed: int = 1
    """Of weights, noise and worlds, 0 to 2^31 - 1; every process derives its own."""
    device: str | None = None
    """A torch device; default: a GPU if there is one."""
    threads: int | None = None
    """CPU threads of each process that share its worlds (default: all cores, shared out to the processes of a machine),
    and of torch (default: half the cores but at least two), whose number OMP_NUM_THREADS overrides. Those of the worlds
    change no result; torch's do in the last digits."""
    log_root: Path = Path("logs")
    """A run is written to log_root/task/time of its start."""
    log_interval: int = 10
    """Iterations between two logged ones."""
    save_interval: int = 100
    """Iterations between two checkpoints."""
    max_checkpoints: int = 3
    """How many of the newest checkpoints stay; the best stays anyway."""
    best_metric: str = "Metrics/success"
    """The logged figure that makes a checkpoint the best; higher is better."""
    resume: str | None = None
    """A checkpoint, a run's folder, `latest` for the task's latest run with a checkpoint, or `latest-or-new`, which
    begins a new run if there is none. `jumper train` resumes with the settings of that run; flags override them. Not
    saved are device, threads, log_root, tensorboard and wandb."""
    init_policy: str | None = None
    """A policy's name or folder, a run's folder (its best checkpoint) or a checkpoint: a new training begins with that
    policy's actor, its weights and its statistics of observations. The critic, the optimiser and the noise are new."""
    trainer: Literal["ppo", "shac", "rsl-rl"] = "ppo"
    """This package's PPO; SHAC, which learns by gradients through the physics; or rsl-rl-lib's PPO for comparison."""
    tensorboard: bool = True
    """Write TensorBoard events."""
    wandb: bool = False
    """Upload to Weights & Biases."""
    ppo: PpoCfg = field(default_factory=PpoCfg)
    """Settings of the algorithm."""
    shac: ShacCfg = field(default_factory=ShacCfg)
    """Settings of SHAC besides."""

    def __post_init__(self) -> None:
        """Raises ValueError: a setting is out of range."""
        object.__setattr__(self, "log_root", Path(self.log_root))
        for name in ("num_envs", "max_iterations", "log_interval", "save_interval", "max_checkpoints"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} must be at least 1, got {getattr(self, name)}")
        check_not_negative("max_seconds", self.max_seconds)
        checked_threads(self.threads)
        check_seed(self.seed)
        for name in ("resume", "init_policy"):
            if self.trainer == "rsl-rl" and getattr(self, name):
                raise InputError(f"{name} is not offered with trainer rsl-rl")
        if self.resume and self.resume != LATEST_OR_NEW and self.init_policy:
            raise InputError("give resume, which goes on with a training, or init_policy, which begins one, not both")
        if self.trainer != "ppo" and self.ppo.symmetry != "off":
            raise InputError(f"symmetry is not offered with trainer {self.trainer}")
