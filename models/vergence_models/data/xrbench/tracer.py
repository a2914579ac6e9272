"""Mitsuba 3 at work: the light that reaches a camera, and the first surface behind each pixel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vergence_models.data.patterns import noise, pattern
from vergence_models.data.xrbench.meshes import Matrix, Mesh
from vergence_models.data.xrbench.things import SPECULAR, Finish, Room, Surface
from vergence_proto.extras import how_to_install

if TYPE_CHECKING:
    from types import ModuleType

Planes = NDArray[np.float32]  # [H, W, C]

# From fast to slow. The last one is compiled into the wheel and needs nothing else.
VARIANTS = ("cuda_ad_rgb", "llvm_ad_rgb", "scalar_rgb")
_OLDEST_LLVM = (19, 0, 0)  # the oldest that was seen to work; 15 does not
_TEXTURE_SIZE = 512
# Mitsuba's cameras have x to the left and y up where OpenCV's have x to the right and y down.
_OPENCV_FROM_MITSUBA = np.diag([-1.0, -1.0, 1.0, 1.0])
_FIRST_HIT = "depth:depth,normal:sh_normal,shape:shape_index,point:position"
_BESIDE_LIGHT = "depth:depth,normal:sh_normal,albedo:albedo"


class NoRenderer(RuntimeError):
    """Mitsuba or what it needs is missing; the message says what to install."""


@dataclass(frozen=True, slots=True)
class Optics:
    """A pinhole camera with square pixels and its axis through the middle of the image."""

    width: int
    height: int
    focal_px: float


@dataclass(frozen=True, slots=True)
class CameraView:
    """Some rows of a camera's image, seen through one point of its lens.

    A lens is the average of pinholes at its points, each turned so that points in focus keep their
    place in the image.
    """

    first_row: int
    rows: int
    lens_m: tuple[float, float] = (0.0, 0.0)  # the point of the lens, right and down of its middle
    focus_m: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class FirstHits:
    """The first hits of the rays through the pixel centres, in world axes."""

    points_m: NDArray[np.float64]  # [H, W, 3]
    normals: NDArray[np.float64]  # [H, W, 3], unit, of the smooth surface
    label: NDArray[np.uint16]  # [H, W]: 1 + the thing's place, lamps after things; 0 is the sky
    specular: NDArray[np.bool_]  # [H, W]: a mirror or glass


@dataclass(frozen=True, slots=True, eq=False)
class TracedLight:
    """The light that pixels receive, averaged over their area, and the first surfaces."""

    radiance: Planes  # [H, W, 3], linear RGB
    albedo: Planes  # [H, W, 3]
    normals: Planes  # [H, W, 3], world axes
    depth_m: Planes  # [H, W, 1], along the ray; 0 for the sky


class Tracer:
    """A room loaded into Mitsuba. Not safe for use by several threads at once.

    Raises NoRenderer: Mitsuba is not installed, or the variant lacks its library.
    """

    def __init__(self, room: Room, *, bounces: int, variant: str | None = None) -> None:
        self._mi = _mitsuba(variant)
        self._room = room
        self._time_s = 0.0
        self._flicker = 1.0
        scene: dict[str, Any] = {"type": "scene", "sky": self._sky()}
        labels, specular = [], []
        for index, thing in enumerate(room.things):
            for part, (surface, mesh) in enumerate(thing.parts):
                name = f"thing{index}_{part}"
                scene[name] = self._mesh(name, mesh.moved(thing.pose(0)), surface)
                labels.append(index + 1)
                specular.append(surface.finish in SPECULAR)
        for index, lamp in enumerate(room.lamps):
            shine = {"type": "area", "radiance": {"type": "rgb", "value": list(lamp.radiance)}}
            # Mitsuba's rectangle faces +z; ours faces -z.
            turned = lamp.world_from_panel @ np.diag([lamp.half_m[0], -lamp.half_m[1], -1, 1])
            frame = self._mi.ScalarTransform4f(turned)
            scene[f"lamp{index}"] = {"type": "rectangle", "to_world": frame, "emitter": shine}
            labels.append(len(room.things) + index + 1)
            specular.append(False)
        path = {"type": "path", "max_depth": bounces + 1, "rr_depth": bounces + 1}
        self._light = self._mi.load_dict({"type": "aov", "aovs": _BESIDE_LIGHT, "light": path})
        self._first_hit = self._mi.load_dict({"type": "aov", "aovs": _FIRST_HIT})
        # Without optimisation: merged meshes would lose the names that separate objects in truth.
        self._scene = self._mi.load_dict(scene, optimize=False)
        order = [shape.id() for shape in self._scene.shapes()]
        names = [name for name in scene if name.startswith(("thing", "lamp"))]
        by_name = dict(zip(names, zip(labels, specular, strict=True), strict=True))
        ids = self._shape_ids()
        self._label = np.zeros(max(ids) + 1, np.uint16)
        self._specular = np.zeros(max(ids) + 1, np.bool_)
        for name, number in zip(order, ids, strict=True):
            self._label[number], self._specular[number] = by_name[name]
        self._parameters = self._mi.traverse(self._scene)
        self._sensors: dict[tuple[Optics, int | None, bool], tuple[Any, Any]] = {}

    def hits(self, optics: Optics, world_from_camera: Matrix, time_s: float) -> FirstHits:
        """Exact: one ray through the centre of each pixel of a pinhole camera."""
        planes = self._render(optics, world_from_camera, time_s, samples=1, seed=0, centred=True)
        planes = planes[..., -8:]  # the film puts a colour before them
        index = np.where(planes[..., 0] > 0, planes[..., 4], 0).astype(int)
        return FirstHits(
            points_m=planes[..., 5:8].astype(np.float64),
            normals=planes[..., 1:4].astype(np.float64),
            label=self._label[index],
            specular=self._specular[index],
        )

    def light(
        self, optics: Optics, world_from_camera: Matrix, time_s: float, *, samples: int, seed: int,
        flicker: float = 1.0, view: CameraView | None = None,
    ) -> TracedLight:  # fmt: skip
        """Path-traced, of the whole image or the rows of a view. `flicker` scales the lamps."""
        if flicker != self._flicker:
            for index, lamp in enumerate(self._room.lamps):
                value = self._mi.Color3f(*(channel * flicker for channel in lamp.radiance))
                self._parameters[f"lamp{index}.emitter.radiance.value"] = value
            self._parameters.update()
            self._flicker = flicker
        planes = self._render(
            optics, world_from_camera, time_s, samples=samples, seed=seed, view=view
        )
        return TracedLight(planes[..., :3], planes[..., 7:10], planes[..., 4:7], planes[..., 3:4])

    def _render(
        self, optics: Optics, world_from_camera: Matrix, time_s: float, *, samples: int, seed: int,
        view: CameraView | None = None, centred: bool = False,
    ) -> Planes:  # fmt: skip
        self._move_things(time_s)
        view = view or CameraView(0, optics.height)
        sensor, parameters = self._sensor(optics, view.rows, centred)
        frame = world_from_camera.copy()
        frame[:3, 3] += frame[:3, :2] @ view.lens_m
        parameters["to_world"] = self._mi.ScalarTransform4f(frame @ _OPENCV_FROM_MITSUBA)
        # A band is an image whose optical axis passes above or below it.
        below = view.first_row - (optics.height - view.rows) / 2
        right, down = (optics.focal_px / view.focus_m * offset for offset in view.lens_m)
        parameters["principal_point_offset_x"] = -right / optics.width
        parameters["principal_point_offset_y"] = (below - down) / view.rows
        parameters.update()
        integrator = self._first_hit if centred else self._light
        image = self._mi.render(
            self._scene, sensor=sensor, integrator=integrator, spp=samples, seed=seed
        )
        return np.array(image, np.float32)

    def _shape_ids(self) -> list[int]:
        """The value of the `shape_index` plane for each shape; 0 means no shape."""
        shapes = self._scene.shapes()
        if self._mi.variant().startswith("scalar"):
            return list(range(1, len(shapes) + 1))
        # A number in the registry of the JIT, which counts the shapes of other scenes as well.
        from drjit import reinterpret_array

        mi = self._mi
        numbers = [np.array(reinterpret_array(mi.UInt32, mi.ShapePtr(each))) for each in shapes]
        return [int(number[0]) for number in numbers]

    def _move_things(self, time_s: float) -> None:
        if time_s == self._time_s:
            return
        for index, thing in enumerate(self._room.things):
            if thing.moves:
                for part, (_, mesh) in enumerate(thing.parts):
                    moved = mesh.moved(thing.pose(time_s))
                    self._shape(f"thing{index}_{part}", moved, self._parameters)
        self._parameters.update()
        self._time_s = time_s

    def _sensor(self, optics: Optics, rows: int, centred: bool) -> tuple[Any, Any]:
        """A cached sensor: the JIT variants would compile a new camera of the same kind again."""
        key = (optics, rows, centred)
        if key not in self._sensors:
            sampler: dict[str, Any] = {"type": "independent"}
            if centred:
                sampler = {"type": "stratified", "jitter": False, "sample_count": 1}
            fov = 2 * np.degrees(np.arctan(optics.width / 2 / optics.focal_px))
            film = {"type": "hdrfilm", "width": optics.width, "height": rows,
                    "pixel_format": "rgb", "component_format": "float32",
                    "rfilter": {"type": "box"}}  # fmt: skip
            sensor = self._mi.load_dict(
                {"type": "perspective", "fov": float(fov), "fov_axis": "x", "near_clip": 0.02,
                 "far_clip": 1000.0, "film": film, "sampler": sampler}
            )  # fmt: skip
            self._sensors[key] = sensor, self._mi.traverse(sensor)
        return self._sensors[key]

    def _mesh(self, name: str, mesh: Mesh, surface: Surface) -> Any:
        properties = self._mi.Properties()
        properties["bsdf"] = self._mi.load_dict(self._bsdf(surface))
        shape = self._mi.Mesh(
            name, len(mesh.points), len(mesh.faces), props=properties,
            has_vertex_normals=True, has_vertex_texcoords=True,
        )  # fmt: skip
        parameters = self._mi.traverse(shape)
        self._shape("", mesh, parameters)
        span = surface.span_m if surface.pattern else 1.0
        parameters["vertex_texcoords"] = np.ravel(mesh.uv / span).astype(np.float32)
        parameters["faces"] = np.ravel(mesh.faces).astype(np.uint32)
        parameters.update()
        return shape

    @staticmethod
    def _shape(name: str, mesh: Mesh, parameters: Any) -> None:
        prefix = f"{name}." if name else ""
        parameters[f"{prefix}vertex_positions"] = np.ravel(mesh.points).astype(np.float32)
        parameters[f"{prefix}vertex_normals"] = np.ravel(mesh.normals).astype(np.float32)

    def _bsdf(self, surface: Surface) -> dict[str, Any]:
        color: dict[str, Any] = {"type": "rgb", "value": list(surface.color)}
        if surface.pattern:
            rng = np.random.default_rng(surface.pattern_seed)
            image = pattern(rng, _TEXTURE_SIZE, surface.pattern)
            color = {"type": "bitmap", "bitmap": self._mi.Bitmap(image)}
        if surface.finish is Finish.GLASS:
            return {"type": "thindielectric", "specular_transmittance": color}
        if surface.finish is Finish.MIRROR:
            inner: dict[str, Any] = {"type": "conductor", "material": "none",
                                     "specular_reflectance": color}  # fmt: skip
        elif surface.finish is Finish.METAL:
            inner = {"type": "roughconductor", "material": "none", "alpha": surface.roughness,
                     "specular_reflectance": color}  # fmt: skip
        elif surface.finish is Finish.SATIN:
            inner = {"type": "roughplastic", "alpha": surface.roughness,
                     "diffuse_reflectance": color}  # fmt: skip
        else:
            inner = {"type": "diffuse", "reflectance": color}
        return {"type": "twosided", "inner": inner}

    def _sky(self) -> dict[str, Any]:
        """Clouds over a dark horizon, in a world whose y axis points down."""
        rng = np.random.default_rng(self._room.sky_seed)
        up = np.linspace(1, -1, 128)[:, None, None]
        clouds = noise(rng, 256, exponent=1.5)[:128, :, None]
        blue, white = np.array([0.45, 0.65, 1.0]), np.array([1.0, 1.0, 1.0])
        above = blue + (white - blue) * np.clip(3 * clouds - 1, 0, 1)
        below = np.array([0.12, 0.15, 0.08]) * (0.6 + 0.8 * clouds)
        image = np.where(up > 0, above, below) * self._room.sky_radiance
        return {
            "type": "envmap",
            "bitmap": self._mi.Bitmap(image.astype(np.float32)),
            "to_world": self._mi.ScalarTransform4f(np.diag([1.0, -1.0, -1.0, 1.0])),
        }


def _mitsuba(variant: str | None) -> ModuleType:
    """Mitsuba with a variant set: the one that is named, or LLVM's where it is there."""
    try:
        import mitsuba
    except ImportError:
        raise NoRenderer(f"Mitsuba 3 is not installed: {how_to_install('bench')}") from None
    name = variant or "llvm_ad_rgb"
    if name not in VARIANTS:
        raise NoRenderer(f"no variant {name!r}; there are {', '.join(VARIANTS)}")
    advice = (
        "llvm_ad_rgb needs LLVM 19 (Debian: apt-get install libllvm19; elsewhere set "
        "DRJIT_LIBLLVM_PATH), cuda_ad_rgb an NVIDIA GPU; scalar_rgb needs nothing, and takes "
        "about eight times as long as LLVM's"
    )
    try:
        mitsuba.set_variant(name)
    except ImportError as error:
        raise NoRenderer(f"Mitsuba cannot run {name}: {error} {advice}") from None
    if name.startswith("llvm"):
        from drjit.detail import llvm_version

        # Older ones load, and then abort the whole process in the middle of a compilation.
        if llvm_version() < _OLDEST_LLVM:
            found = ".".join(map(str, llvm_version()))
            raise NoRenderer(f"Mitsuba found LLVM {found}: {advice}")
    return mitsuba
