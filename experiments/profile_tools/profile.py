"""Kernel times of one environment step and of one PPO update, and times of collecting and updating, as JSON and text.

    python profile.py TREE [--worlds 8192] [--iterations 50] [--steps 64] [--set MODULE.NAME=VALUE ...] [--out FILE]
                      [--part env|ppo|both] [--label TEXT]

TREE: source tree of the project. --set changes a constant of a module before anything is built, such as
`jumper_warp.rl.fused.networks.MOST_SPLITS=32`; it is repeated for several constants. Without a GPU the env part times
each launch on the host, and the update has no table.
"""

import importlib.util
import sys
import sysconfig

if __name__ == "profile":  # the standard library's module of this name, which cProfile imports
    _spec = importlib.util.spec_from_file_location("profile", sysconfig.get_path("stdlib") + "/profile.py")
    _module = importlib.util.module_from_spec(_spec)
    _spec.loader.exec_module(_module)
    globals().update(vars(_module))
else:
    import argparse
    import ast
    import importlib
    import json
    import re
    import time
    from collections import defaultdict
    from pathlib import Path

    BEGIN = time.perf_counter()
    parser = argparse.ArgumentParser()
    parser.add_argument("tree")
    parser.add_argument("--worlds", type=int, default=8192)
    parser.add_argument("--iterations", type=int, default=50)
    parser.add_argument("--steps", type=int, default=64)
    parser.add_argument("--warm", type=int, default=100)
    parser.add_argument("--task", default="vertical-jump")
    parser.add_argument("--policy", default="vertical_jump")
    parser.add_argument("--set", action="append", default=[])
    parser.add_argument("--part", choices=("env", "ppo", "both"), default="both")
    parser.add_argument("--device", default=None)
    parser.add_argument("--label", default="")
    parser.add_argument("--out", default=None)
    args = parser.parse_args()
    here = str(Path(__file__).resolve().parent)
    sys.path[:] = [str(Path(args.tree).resolve()), *(p for p in sys.path if p not in ("", here))]

    import torch
    import warp as wp

    from jumper_warp.envs.env import Env
    from jumper_warp.policies.policy import load_policy
    from jumper_warp.registry import make_task
    from jumper_warp.rl.cfg import PpoCfg
    from jumper_warp.rl.fused import make_ppo
    from jumper_warp.rl.logger import Stopwatch

    assert Path(args.tree).resolve() in Path(sys.modules["jumper_warp.envs.env"].__file__).resolve().parents
    for change in args.set:
        path, value = change.split("=", 1)
        module, name = path.rsplit(".", 1)
        module = importlib.import_module(module)
        assert hasattr(module, name), change
        setattr(module, name, ast.literal_eval(value))
    DEVICE = wp.get_device(args.device)
    GPU = DEVICE.is_cuda
    RESULT = {"label": args.label, "tree": args.tree, "set": args.set, "worlds": args.worlds, "device": DEVICE.name}

    def short(name):
        """Return a kernel's name without Warp's and C++'s additions."""
        match = re.match(r"(\w+?_kernel)(?:_|\b)", name)
        if match and "cuda_kernel" in name:
            return match[1]
        return re.sub(r"<.*", "", name.replace("void ", ""))[:60]

    def profiled(function):
        """Run a function under CUPTI; return {name: (total µs, count)} of kernels, copies and fills."""
        from torch.profiler import ProfilerActivity, profile

        wp.synchronize_device(DEVICE)
        with profile(activities=[ProfilerActivity.CUDA]) as prof:
            function()
            wp.synchronize_device(DEVICE)
        times = defaultdict(lambda: [0.0, 0])
        events = [e for e in prof.profiler.kineto_results.events() if str(e.device_type()).endswith("CUDA")]
        for event in events:
            micro = event.duration_ns() / 1e3 if hasattr(event, "duration_ns") else event.duration_us()
            times[short(event.name())][0] += micro
            times[short(event.name())][1] += 1
        return dict(times)

    def warp_timed(launch):
        """Return {name: (total µs, count)} of direct launches, timed by Warp's events (GPU) or the host (CPU)."""
        times = defaultdict(lambda: [0.0, 0])
        if GPU:
            wp.timing_begin(cuda_filter=wp.TIMING_KERNEL)
            launch()
            for entry in wp.timing_end():
                name = short(entry.name.replace("forward kernel ", "") + "_cuda_kernel")
                times[name][0] += 1e3 * entry.elapsed
                times[name][1] += 1
            return dict(times)
        original = wp.launch

        def timed(kernel, *a, **k):
            begin = time.perf_counter()
            original(kernel, *a, **k)
            key = re.sub(r"_kernel.*", "_kernel", kernel.key)
            times[key][0] += 1e6 * (time.perf_counter() - begin)
            times[key][1] += 1

        wp.launch = timed
        try:
            launch()
        finally:
            wp.launch = original
        return dict(times)

    def show(title, times, per, unit="step"):
        """Print a table of kernels, sorted by time, divided by the number `per` of steps or updates."""
        print(f"-- {title} [µs a {unit}]")
        for name, (total, count) in sorted(times.items(), key=lambda x: -x[1][0]):
            print(f"   {total / per:9.2f}  {count / per:7.2f} x {total / count:8.2f}  {name}")
        print(f"   {sum(t for t, _ in times.values()) / per:9.2f}  all")
        return {name: [total / per, count / per] for name, (total, count) in times.items()}

    def seconds(function, calls):
        """Return the wall time of a call, with a wait before and after."""
        wp.synchronize_device(DEVICE)
        begin = time.perf_counter()
        for _ in range(calls):
            function()
        wp.synchronize_device(DEVICE)
        return (time.perf_counter() - begin) / calls

    env = Env(make_task(args.task), args.worlds, device=args.device)
    env.reset()
    if args.part in ("env", "both"):
        policy = load_policy(args.policy, env.device)
        for _ in range(args.warm):
            env.step(policy.act(env.obs))
        start = env.state_dict()
        actions = []
        ended = 0.0
        for _ in range(args.steps):
            actions.append(policy.act(env.obs))
            env.step(actions[-1])
            ended += float(env.done.mean())

        def steps():
            """Repeat the recorded steps."""
            for action in actions:
                env.step(action)

        RESULT["ended_fraction"] = ended / args.steps
        walls = []
        for _ in range(5):
            env.load_state_dict(start)
            walls.append(1e6 * seconds(steps, 1) / args.steps)
        RESULT["step_us"] = sorted(walls)[2]
        print(f"env step {RESULT['step_us']:.1f} µs ({', '.join(f'{w:.1f}' for w in walls)}), "
              f"{100 * RESULT['ended_fraction']:.3f} % of the worlds end a step")
        env.load_state_dict(start)
        times = {}
        if GPU:
            try:
                times = profiled(steps)
                # copies of actions are torch's
            except Exception as error:
                print("profiler failed:", error)
        if not any("kernel" in name for name in times):
            env.load_state_dict(start)

            def direct():
                """Launch the recorded steps without graphs."""
                for action in actions:
                    env.action.copy_(action)
                    env._launch_step()

            times = warp_timed(direct)
        table = RESULT["env"] = show("environment step", times, args.steps)
        beside = sum(t for name, (t, _) in table.items() if not name.startswith("advance"))
        RESULT["beside_physics_us"] = beside
        print(f"   {beside:9.2f}  all beside the physics; {len(times)} kernels")

    if args.part in ("ppo", "both"):
        torch.manual_seed(1)
        env.reset(seed=3)
        cfg = PpoCfg()
        ppo = make_ppo(env, cfg)
        ppo.compile()
        for _ in range(3):
            ppo.iterate()
        wp.synchronize_device(DEVICE)
        stopwatch = Stopwatch(env.device)

        def iterate():
            """Run one iteration, and mark the ends of its parts."""
            stopwatch.start()
            ppo.iterate(mark=stopwatch.mark)

        wall = seconds(iterate, args.iterations)
        (collect, update), _ = stopwatch.read()
        RESULT |= {"iteration_ms": 1e3 * wall, "collect_ms": 1e3 * collect, "update_ms": 1e3 * update}
        print(f"PPO: iteration {1e3 * wall:.3f} ms = collect {1e3 * collect:.3f} + update {1e3 * update:.3f} ms, "
              f"{cfg.num_steps * args.worlds / wall / 1e6:.2f} M steps/s, over {args.iterations} iterations")
        if GPU:
            torch.cuda.synchronize()
            batch, epochs = seconds(lambda: ppo._batch_graph(), 5), seconds(lambda: ppo._epochs_graph(), 5)
            RESULT |= {"batch_ms": 1e3 * batch, "epochs_ms": 1e3 * epochs}
            print(f"     update alone: batch {1e3 * batch:.3f} ms, epochs {1e3 * epochs:.3f} ms")
            try:
                RESULT["collect"] = show("collecting", profiled(ppo.collect), cfg.num_steps)
                RESULT["batch"] = show("batch of an update", profiled(ppo._batch_graph), 1, "update")
                updates = cfg.epochs * cfg.minibatches
                RESULT["epochs"] = show("minibatch", profiled(ppo._epochs_graph), updates, "minibatch")
            except Exception as error:
                print("profiler failed:", error)
        digest = float(ppo.flat.value.double().sum())
        print(f"     sum of the weights {digest!r}")
        RESULT["weights"] = digest

    RESULT["seconds"] = time.perf_counter() - BEGIN
    print(f"{RESULT['seconds']:.1f} s in all")
    if args.out:
        Path(args.out).parent.mkdir(parents=True, exist_ok=True)
        Path(args.out).write_text(json.dumps(RESULT, indent=1))
