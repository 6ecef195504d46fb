"""What the wheel holds; all else is in `pyproject.toml`. The assets, beside the packages here, go into one of them."""

from setuptools import find_namespace_packages, setup

setup(
    packages=[*find_namespace_packages(include=["jumper_warp*", "kernels*"]), "jumper_warp.assets"],
    package_dir={"jumper_warp.assets": "assets"},
    package_data={"jumper_warp.assets": ["*/*", "*/*/*"]},
)
