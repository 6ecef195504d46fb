"""Rendering of triangle meshes without a display, with OpenGL or, where it is missing, ray tracing.

OpenGL (Newton's `ViewerGL`) draws soft shadows, lines and transparent bodies. The ray tracer (Newton's `SensorCamera`)
is four times slower and draws neither lines nor transparency.
"""

from __future__ import annotations

import importlib
import math
import sys
from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, ClassVar, cast

import newton
import numpy as np
import warp as wp

from jumper_warp.utils.checks import check_number
from jumper_warp.utils.errors import InputError
from jumper_warp.utils.newton_types import Model, State
from jumper_warp.viz.shapes import ShapeMesh

FIELD_OF_VIEW = 30.0  # [deg] vertical angle of view
SUN = (-0.35, -0.45, 0.82)  # direction to the sun, world frame
SKY = (0.93, 0.95, 0.97)  # RGB of the sky above
HORIZON = (0.83, 0.87, 0.91)  # RGB of the sky at the horizon
AMBIENT = (0.55, 0.56, 0.60)  # linear RGB of the ray tracer's ambient light
EXPOSURE = 1.15  # [1] brightness with OpenGL
SHADOW_EXTENT = 6.0  # [m] distance from the world's origin up to which OpenGL draws shadows
SAMPLES = 4  # rays per pixel of the ray tracer
LINE_WIDTH = 1.0 / 560.0  # [1] width of lines over the image's width
GL_PACKAGES = "apt-get install libegl1 libegl-mesa0 libgl1 libgl1-mesa-dri"
NO_GL = f'pip install "jumper-warp[video]", and on Debian {GL_PACKAGES}'


@dataclass(frozen=True)
class View:
    """Pinhole camera at `eye`, aimed at `target`, with z up in the image."""

    eye: np.ndarray  # (3,) [m] world frame
    target: np.ndarray  # (3,) [m] world frame, at the image's centre
    field_of_view: float = FIELD_OF_VIEW  # [deg] vertical

    def axes(self) -> np.ndarray:
        """Return the unit vectors right, up and ahead of the image as rows, (3, 3), world frame.

        Raises InputError: eye and target are on one vertical line, or the eye is no point, or the angle out of range.
        """
        check_number("field_of_view", self.field_of_view, 1.0, 120.0, "deg")
        if np.shape(self.eye) != (3,) or not np.isfinite(self.eye).all():
            raise InputError(f"eye must be three finite coordinates, got {self.eye!s:.60}")
        ahead = np.asarray(self.target, dtype=float) - np.asarray(self.eye, dtype=float)
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        if np.linalg.norm(right) < 1.0e-6 * max(1.0, float(np.linalg.norm(ahead))):
            eye, target = (tuple(np.asarray(point, dtype=float).tolist()) for point in (self.eye, self.target))
            raise InputError(f"the view from {eye} to {target} is vertical")
        ahead = ahead / np.linalg.norm(ahead)
        right = right / np.linalg.norm(right)
        return np.stack([right, np.cross(right, ahead), ahead])

    def project(self, points: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        """Project points (n, 3) [m], world frame, to pixels (n, 2) from the image's upper left corner.

        size: width and height [px]. Points behind the camera become NaN.
        """
        right, up, depth = ((np.asarray(points, dtype=float) - self.eye) @ self.axes().T).T
        depth = np.where(depth > 1.0e-6, depth, np.nan)
        focal = 0.5 * size[1] / math.tan(0.5 * math.radians(self.field_of_view))
        return np.stack([0.5 * size[0] + focal * right / depth, 0.5 * size[1] - focal * up / depth], axis=1)


@dataclass(frozen=True)
class Line:
    """Polyline of one color, with a constant width in the image."""

    points: np.ndarray  # (n, 3) [m], world frame
    color: tuple[float, float, float]  # RGB, each in [0, 1]
    arrow: bool = False  # Draw an arrow from the first to the last point


class Renderer(ABC):
    """Renderer of bodies with triangle meshes at given poses. Use it as a context manager, or call `close`."""

    name: str  # in words, for messages

    def __init__(
        self, shapes: Sequence[ShapeMesh], num_bodies: int, size: tuple[int, int], opacity: Sequence[float] = (1.0,)
    ) -> None:
        """Prepare images of a size, width and height [px]; other arguments: see `load`."""
        self.size = size
        self.load(shapes, num_bodies, opacity)

    def load(self, shapes: Sequence[ShapeMesh], num_bodies: int, opacity: Sequence[float] = (1.0,)) -> None:
        """Load the bodies to draw, one copy of all bodies for each entry of `opacity`: moments in one picture.

        Shapes that are fixed to the world are loaded once. num_bodies: number of bodies that `ShapeMesh.body` indexes.
        opacity: of each copy, 0 to 1.
        """
        self.model = _scene_model(shapes, num_bodies, opacity)
        self.state: State = self.model.state()

    def draw(self, poses: np.ndarray, view: View, lines: Sequence[Line] = ()) -> np.ndarray:
        """Draw an image, (height, width, 3) uint8, RGB, row 0 on top.

        poses: of the bodies of every copy, (copies * num_bodies, 7), position [m] and quaternion xyzw, world frame.
        Raises InputError: a vertical view.
        """
        view.axes()  # OpenGL's camera would turn a vertical view without an error
        self.state.body_q.assign(np.ascontiguousarray(poses, dtype=np.float32).reshape(-1, 7))
        return self._image(view, lines)

    @abstractmethod
    def _image(self, view: View, lines: Sequence[Line]) -> np.ndarray:
        """Return an image of the poses in `state`, (height, width, 3) uint8, RGB."""

    def close(self) -> None:  # noqa: B027, nothing to free by default
        """Free the renderer's resources; it cannot draw afterwards."""

    def __enter__(self) -> Renderer:
        """Return the renderer itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the renderer."""
        self.close()


class GLRenderer(Renderer):
    """Renderer with OpenGL: Newton's viewer in an invisible window.

    The next renderer of the same size reuses the window of a closed one, since closing a window leaks its memory.
    """

    _idle: ClassVar[dict[tuple[int, int], list[Any]]] = {}  # viewers without a renderer, by size [px]

    name = "OpenGL"

    def __init__(
        self, shapes: Sequence[ShapeMesh], num_bodies: int, size: tuple[int, int], opacity: Sequence[float] = (1.0,)
    ) -> None:
        """Prepare rendering with OpenGL, with the arguments of `Renderer`.

        Raises ImportError: no pyglet; RuntimeError: OpenGL is missing or too old.
        """
        idle = self._idle.setdefault(size, [])
        self._viewer: Any = idle.pop() if idle else _gl_viewer(size)
        super().__init__(shapes, num_bodies, size, opacity)
        viewer = self._viewer
        viewer.show_joints = viewer.show_com = False
        renderer = viewer.renderer
        renderer.spotlight_enabled = False
        renderer.sky_upper = SKY
        renderer.sky_lower = HORIZON
        renderer._sun_direction = np.array(SUN) / np.linalg.norm(SUN)
        renderer.exposure = EXPOSURE
        renderer.shadow_extents = SHADOW_EXTENT
        renderer.line_width = LINE_WIDTH * size[0]
        renderer.arrow_scale = 0.6 * LINE_WIDTH * size[0]

    def load(self, shapes: Sequence[ShapeMesh], num_bodies: int, opacity: Sequence[float] = (1.0,)) -> None:
        """Load the bodies to draw into OpenGL's viewer; arguments: see `Renderer.load`."""
        super().load(shapes, num_bodies, opacity)
        self._viewer.renderer._make_current()
        self._viewer.set_model(self.model)

    def _image(self, view: View, lines: Sequence[Line]) -> np.ndarray:
        """Return an image of the poses in `state`, drawn by Newton's viewer in its invisible window."""
        viewer = self._viewer
        camera = self._viewer.camera
        viewer.renderer._make_current()  # another window may have drawn since
        camera.fov = view.field_of_view
        camera.pos = camera._as_vec3(view.eye)
        camera.look_at(view.target)
        viewer.begin_frame(0.0)
        viewer.log_state(self.state)
        for arrow, log in ((False, viewer.log_lines), (True, viewer.log_arrows)):
            log(f"lines/{arrow}", *_segments([line for line in lines if line.arrow == arrow]))
        viewer.end_frame()
        return viewer.get_frame().numpy().copy()

    def close(self) -> None:
        """Free the bodies, and store the window for the next renderer."""
        viewer = self._viewer
        self._viewer = None
        if viewer is not None:
            viewer.renderer._make_current()
            viewer.set_model(None)
            self._idle[self.size].append(viewer)


class RayTracer(Renderer):
    """Renderer by ray tracing, without OpenGL; it draws neither lines nor transparency."""

    name = "ray tracing"

    def __init__(
        self, shapes: Sequence[ShapeMesh], num_bodies: int, size: tuple[int, int], opacity: Sequence[float] = (1.0,)
    ) -> None:
        """Prepare rendering by ray tracing, with the arguments of `Renderer`."""
        super().__init__(shapes, num_bodies, size, opacity)
        self._rays: Any = None
        self._field_of_view = 0.0  # [deg] of `_rays`

    def load(self, shapes: Sequence[ShapeMesh], num_bodies: int, opacity: Sequence[float] = (1.0,)) -> None:
        """Load the bodies to draw, and prepare light, sky and image; arguments: see `Renderer.load`."""
        from newton.sensors import SensorCamera  # takes half a second, which OpenGL does not need

        super().load(shapes, num_bodies, opacity)
        self._sensor = SensorCamera(self.model)
        rays: Any = wp.vec3(*(-np.array(SUN) / np.linalg.norm(SUN)))
        self._sensor.create_default_light(direction=rays)
        self._sensor.set_ambient_light(AMBIENT)
        red, green, blue = (round(255 * channel) for channel in SKY)
        color = (0xFF000000 | blue << 16 | green << 8 | red) - (1 << 32)  # as int32: clang warns about larger constants
        self._sensor.default_clear_data = SensorCamera.ClearData(clear_color=color)
        self._sensor.default_render_config.enable_shadows = True
        self._sensor.default_render_config.anti_aliasing = SensorCamera.AntiAliasing.SSAA
        self._pixels: Any = self._sensor.allocate_image_color(1, *self.size)

    def _image(self, view: View, lines: Sequence[Line]) -> np.ndarray:
        """Return an image of the poses in `state`, without lines; Newton's cameras look along their -z axis."""
        from newton.sensors import SensorCamera
        from scipy.spatial.transform import Rotation

        if view.field_of_view != self._field_of_view:
            self._field_of_view = view.field_of_view
            self._rays = SensorCamera.compute_camera_rays_pinhole(
                *self.size, camera_fov=math.radians(view.field_of_view), sample_count=SAMPLES, device=self.model.device
            )
        right, up, ahead = view.axes()
        quat = Rotation.from_matrix(np.stack([right, up, -ahead], axis=1)).as_quat()  # xyzw
        pose = wp.array(np.concatenate([view.eye, quat])[None].astype(np.float32), dtype=wp.transformf)
        self.model.bvh_refit_shapes(self.state)
        self._sensor.update(self.state, pose, self._rays, color_image=self._pixels)
        colors: Any = SensorCamera.Utils.to_rgba_from_color(self._pixels)
        return colors.numpy()[0, ..., :3].copy()


def open_renderer(
    shapes: Sequence[ShapeMesh], num_bodies: int, size: tuple[int, int], opacity: Sequence[float] = (1.0,)
) -> Renderer:
    """Return an OpenGL renderer or, with a notice on standard error, a ray tracer; arguments: see `Renderer`."""
    try:
        return GLRenderer(shapes, num_bodies, size, opacity)
    except (ImportError, RuntimeError, OSError) as error:
        reason = " ".join(str(error).split())[:100]
        print(f"no OpenGL ({reason}), using the slow ray tracer; to install OpenGL: {NO_GL}", file=sys.stderr)
        return RayTracer(shapes, num_bodies, size, opacity)


def _gl_viewer(size: tuple[int, int]) -> Any:
    """Return Newton's viewer in an invisible window of a size [px].

    Raises ImportError: pyglet is missing; RuntimeError: no OpenGL.
    """
    import pyglet

    with suppress(ImportError):  # its LLVM must be loaded before that of Mesa, or importing it later crashes
        importlib.import_module("triton")
    pyglet.options["headless"] = True  # read when pyglet's window module is first imported
    try:
        return newton.viewer.ViewerGL(width=size[0], height=size[1], headless=True)
    except ImportError:
        raise
    except Exception as error:  # pyglet and Newton raise many kinds, of no common base
        raise RuntimeError(f"{type(error).__name__}: {error}") from error


def _scene_model(shapes: Sequence[ShapeMesh], num_bodies: int, opacity: Sequence[float]) -> Model:
    """Build a Newton model of all robots to draw, one copy of the robot's links for each entry of `opacity`.

    It is only drawn: links are kinematic, without mass and collisions. Both of Newton's renderers draw a model.
    """
    builder = newton.ModelBuilder()
    builder.default_shape_cfg = newton.ModelBuilder.ShapeConfig(density=0.0, has_shape_collision=False)
    meshes = [
        newton.Mesh(shape.vertices, shape.triangles.ravel(), normals=shape.normals, compute_inertia=False)
        for shape in shapes
    ]
    for copy, alpha in enumerate(opacity):
        for _ in range(num_bodies):
            builder.add_body(is_kinematic=True)
        for shape, mesh in zip(shapes, meshes, strict=True):
            if shape.body >= 0:
                body = copy * num_bodies + shape.body
                builder.add_shape_mesh(body, mesh=mesh, color=shape.color, opacity=alpha)
            elif copy == 0:
                builder.add_shape_mesh(-1, mesh=mesh, color=shape.color)
    return cast(Model, builder.finalize())


def _segments(lines: Sequence[Line]) -> tuple[wp.array | None, wp.array | None, wp.array | None]:
    """Convert polylines to line segments: return starts, ends [m], world frame, and colors; an arrow is one segment.

    All are arrays of vec3, as Newton's viewer draws them; None hides the lines of the last image.
    """
    if not lines:
        return None, None, None
    parts = [line.points[[0, -1]] if line.arrow else line.points for line in lines]
    colors = [np.tile(line.color, (len(points) - 1, 1)) for line, points in zip(lines, parts, strict=True)]
    starts, ends, shades = (
        wp.array(np.concatenate(values).astype(np.float32), dtype=wp.vec3)
        for values in ([points[:-1] for points in parts], [points[1:] for points in parts], colors)
    )
    return starts, ends, shades
