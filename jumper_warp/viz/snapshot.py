"""Images of a Newton model, ray-traced without a display."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.figure
import matplotlib.image
import numpy as np
import warp as wp
from newton.sensors import SensorCamera

from jumper_warp.utils.errors import InputError
from jumper_warp.utils.newton_types import Model, State

EYE = (1.1, 1.4, 0.6)  # [m] default position of the eye, world frame: ahead of the robot, on its left
TARGET = (0.0, 0.0, 0.25)  # [m] default point at the centre of the image, world frame
SIZE = (640, 480)  # [px] default width and height
FIELD_OF_VIEW = math.radians(40.0)  # [rad] vertical angle of view
LIGHT_DIRECTION = (-0.35, -0.45, -0.82)  # direction of the light rays, world frame; from behind the default eye
AMBIENT = (0.55, 0.56, 0.60)  # linear RGB of the ambient light, so that shaded sides stay visible
SKY = 0xFFF5F0EC  # background color: alpha, blue, green, red
SAMPLES = 4  # rays per pixel


class Camera:
    """A fixed camera that renders one world of a model."""

    def __init__(
        self,
        model: Model,
        eye: Sequence[float] = EYE,
        target: Sequence[float] = TARGET,
        size: tuple[int, int] = SIZE,
        world: int = 0,
    ) -> None:
        """Place the camera at `eye` with `target` at the image centre [m], world frame; size: width, height [px].

        Raises InputError: eye and target are on one vertical line, or the model has no such world.
        """
        if not 0 <= world < model.world_count:
            raise InputError(f"world {world} is outside the model's {model.world_count} worlds")
        self._model = model
        self._sensor = SensorCamera(model)
        direction: Any = wp.vec3(*LIGHT_DIRECTION)
        self._sensor.create_default_light(direction=wp.normalize(direction))
        self._sensor.set_ambient_light(AMBIENT)
        self._sensor.default_clear_data = SensorCamera.ClearData(clear_color=SKY)
        self._sensor.default_render_config.enable_shadows = True
        self._sensor.default_render_config.anti_aliasing = SensorCamera.AntiAliasing.SSAA
        self._rays = SensorCamera.compute_camera_rays_pinhole(
            *size, camera_fov=FIELD_OF_VIEW, sample_count=SAMPLES, device=model.device
        )
        self._pose = wp.array([look_at(eye, target)], dtype=wp.transformf, device=model.device)
        self._world = wp.array([world], dtype=wp.int32, device=model.device)
        self._pixels: Any = self._sensor.allocate_image_color(1, *size)

    def picture(self, state: State) -> np.ndarray:
        """Return an image of a state's body poses `body_q`, (height, width, 3) uint8, RGB, row 0 on top."""
        self._model.bvh_refit_shapes(state)
        self._sensor.update(state, self._pose, self._rays, color_image=self._pixels, world_indices=self._world)
        colors: Any = SensorCamera.Utils.to_rgba_from_color(self._pixels)
        return colors.numpy()[0, ..., :3].copy()


def look_at(eye: Sequence[float], target: Sequence[float]) -> wp.transformf:
    """Return the pose of a camera at `eye` that looks at `target` [m], world frame; its -z points ahead, its +y up.

    Raises InputError: eye and target are on one vertical line.
    """
    ahead = np.asarray(target, dtype=float) - np.asarray(eye, dtype=float)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 1.0e-6 * max(1.0, float(np.linalg.norm(ahead))):
        raise InputError(f"cannot look from {tuple(eye)} to {tuple(target)}: no horizontal distance")
    ahead /= np.linalg.norm(ahead)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(right, ahead), -ahead], axis=1)
    position: Any = wp.vec3(*map(float, eye))
    matrix: Any = wp.mat33(*axes.ravel().tolist())
    orientation: Any = wp.quat_from_matrix(matrix)
    return wp.transformf(position, orientation)


def contact_sheet(
    pictures: Sequence[np.ndarray], path: Path, captions: Sequence[str] | None = None, columns: int | None = None
) -> Path:
    """Write pictures, (height, width, 3) uint8 of one size, row by row into one PNG file; return its path.

    captions: one for each picture, drawn in its upper left corner. columns: pictures in a row, by default all. Raises
    InputError: no pictures, unequal sizes, or another number of captions.
    """
    if not pictures or len({picture.shape for picture in pictures}) != 1:
        raise InputError("a contact sheet needs pictures, all of one size")
    captions = [""] * len(pictures) if captions is None else captions
    if len(captions) != len(pictures):
        raise InputError(f"{len(pictures)} pictures have {len(captions)} captions")
    columns = len(pictures) if columns is None else columns
    rows = -(-len(pictures) // columns)
    height, width, _ = pictures[0].shape
    sheet = np.full((rows * height, columns * width, 3), 255, dtype=np.uint8)
    figure = matplotlib.figure.Figure(figsize=(columns * width / 100, rows * height / 100), dpi=100)
    for index, (picture, caption) in enumerate(zip(pictures, captions, strict=True)):
        y, x = height * (index // columns), width * (index % columns)
        sheet[y : y + height, x : x + width] = picture
        figure.text((x + 8) / sheet.shape[1], 1.0 - (y + 8) / sheet.shape[0], caption, va="top", fontsize=10)
    figure.figimage(sheet)
    figure.savefig(path, dpi=100)
    return Path(path)
