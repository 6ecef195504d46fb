"""Leave out the tests of clients that are not installed; `make clients` installs them all."""

from importlib.util import find_spec

CLIENTS = {
    "test_sb3.py": "stable_baselines3",
    "test_torchrl.py": "torchrl",
    "test_skrl.py": "skrl",
    "test_openvino.py": "openvino",
}
collect_ignore = [file for file, module in CLIENTS.items() if find_spec(module) is None]
