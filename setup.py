"""What the wheel holds; all else is in `pyproject.toml`.

`jumper_warp/kernels` is a link to `kernels/`, and the assets, beside the package here, go into it. `make page` writes
`jumper_warp/live/page/dist`, which is not in git and goes into the wheel if it is there.
"""

from setuptools import find_namespace_packages, setup

setup(
    packages=[
        *find_namespace_packages(include=["jumper_warp*"], exclude=["jumper_warp.live.page*"]),
        "jumper_warp.assets",
    ],
    package_dir={"jumper_warp.assets": "assets"},
    package_data={
        "jumper_warp.assets": ["*/*", "*/*/*"],
        "jumper_warp.live": ["*.js", "page/dist/*"],
        "jumper_warp.viz": ["*.mplstyle"],
    },
)
