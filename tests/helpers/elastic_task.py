"""A training for torchrun: `torchrun elastic_task.py FOLDER [DEATH ...]`; each DEATH is `restart,rank,step`.

The process of that rank kills itself in that environment step after that restart.
"""

import os
import signal
import sys
from pathlib import Path

from jumper_warp.rl.runner import train
from toy_task import SMALL, PushTask, push_cfg

STEPS = SMALL.num_steps


class Mortal(PushTask):
    """A task that kills its process at the given step, like a preempted machine."""

    def step(self, action):
        super().step(action)
        self.count = getattr(self, "count", 0) + 1
        life = [os.environ["TORCHELASTIC_RESTART_COUNT"], os.environ["RANK"], str(self.count)]
        if ",".join(life) in sys.argv[2:]:
            os.kill(os.getpid(), signal.SIGKILL)


if __name__ == "__main__":
    cfg = push_cfg(Path(sys.argv[1]), resume="latest-or-new", max_iterations=6, log_interval=1, max_checkpoints=10)
    train(cfg, lambda n, seed, device: Mortal(n, seed, device, episode_length=20 + 7 * int(os.environ["RANK"])))
    # a thread of the group that outlives Python can abort the process
    assert "gloo" not in "".join(path.read_text() for path in Path("/proc/self/task").glob("*/comm"))
