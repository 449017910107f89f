"""Frame after frame on OpenCL: nothing is made again that did not change.

    set up the camera's triangles -> [set up and draw the lights' maps] -> fill, test and shade tiles

A new light draws its shadow map again, a new camera only the picture. In a new scene, meshes are uploaded again when
one of them changed, a BTF or an MDF when it was not there before, and shadow maps are drawn again when a mesh or an MDF
changed. The torch frame (`frame.render`) is the formula of all of this.

Kernels: kernels_cl/render/renderer.cl, kernels_cl/render/shadow_map.cl          Test: tests/render/test_renderer.py
"""

import itertools
import operator
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from torchmeso.backends import opencl
from torchmeso.data import image
from torchmeso.errors import BackendError, check_memory
from torchmeso.geometry import shell
from torchmeso.geometry.camera import Camera
from torchmeso.geometry.light import DirectionalLight, Light, SpotLight
from torchmeso.render import device, device_gdm, device_shell, device_tables, film, shadow_map
from torchmeso.render.casters import Corners, corners_of
from torchmeso.render.device_raster import ROOM, STAMPS, DeviceViews
from torchmeso.render.film import Picture
from torchmeso.render.frame import MEMORY_LIMIT, FrameOptions, Skips
from torchmeso.render.scene import Material, Scene, World, assemble

MAX_LIGHTS = 64
"""Of a frame, as in kernels_cl/render/shadow_map.clh."""

DETAILS, DISPLAY = 1, 2
"""What a frame writes: a `Picture`, or bytes for a screen."""

MOST_STARTS = 4
"""Tetrahedra of shells that the eye is in; the others of a shell that overlaps itself more often are left out."""

FRAME = np.dtype(
    [(name, "i4") for name in ("lights", "ambient_paper", "depths", "outputs")]
    + [(name, "i4") for name in ("capacity", "skips", "stride", "pitch")]
    + [("ambient", "f4"), ("background", "f4", 3), ("rank_error", "f4"), ("pixel", "f4")]
    + [("starts", "i4"), ("pad", "i4"), ("start_tet", "i4", MOST_STARTS), ("start_surface", "i4", MOST_STARTS)]
    + [("start_place", "f4", (MOST_STARTS, 4))]
)


class Renderer:
    """Renders a scene on the device; cameras and lights may change from frame to frame, and the scene by `update`."""

    def __init__(self, scene: Scene, options: FrameOptions | None = None, *, one_layer: bool = False):
        """Upload `scene`; with `one_layer` only the nearest fragment of a pixel is kept (a yardstick for benchmarks).

        Raises:
            BackendError: there is no device, or a material is of a kind that kernels do not read.
        """
        start = time.perf_counter()
        self.options = options or FrameOptions()
        self._skips, self._one_layer = self.options.skips, one_layer
        self._workers = opencl.units()
        self._extra, self._cut_room, self._light_room, self._kept_room = 4096, 0, 1, 0
        self._lists: tuple[opencl.Buffer, opencl.Buffer] | None = None
        self._picture: _Picture | None = None
        self._maps: _Maps | None = None
        self.counts: dict[str, int] = {}
        self._on_device = _upload(scene, self.options)
        self._choose_code()
        self._uploaded = self._on_device.since(None)
        self._seconds = {"upload": time.perf_counter() - start}

    def update(self, scene: Scene) -> None:
        """Render `scene` from now on; what is the same as before stays on the device.

        Meshes, BTFs and MDFs are compared by identity: change a copy (`dataclasses.replace`), never one in place.

        Raises:
            BackendError: a material is of a kind that kernels do not read; the scene from before is still rendered.
        """
        start = time.perf_counter()
        before, self._on_device = self._on_device, _upload(scene, self.options, self._on_device)
        self._choose_code()
        moved = self._on_device.geometry is not before.geometry
        if self._maps is not None:
            if moved:
                self._maps.views = self._views(self._maps.views.count)
            if moved or not _are(_depths(scene), _depths(before.scene)):
                self._maps.lights = None
            self._maps.draw = self._map_calls(self._maps)
        if self._picture is not None:
            if moved:
                self._picture.views = self._views(1)
            self._picture.draw = self._picture_call(self._picture)
            self._picture.outputs = 0  # the background may be another
        self._uploaded = self._on_device.since(before)
        self._seconds = {"upload": time.perf_counter() - start}

    def _choose_code(self) -> None:
        """Compile in what this scene needs."""
        textured = self._on_device.materials.textured or not self._skips.plain
        mode = {"none": 0, "paper": 1, "curved": 2}[self.options.silhouette] if textured else 0
        mixed = mode != 0 and self._on_device.mixed
        wanted = (
            ("-DONE_LAYER", self._one_layer),
            ("-DMIXED", mixed),
            ("-DHARMONICS", self._on_device.materials.harmonic),
            ("-DQUILTED", self._on_device.materials.quilted),
            ("-DGDM", self._on_device.shells is not None),
        )
        self._defines = (f"-DSILHOUETTE={mode}", *(name for name, needed in wanted if needed))
        self._plain = mode == 0 and self.options.silhouette != "none"
        self._cull = mode == 0 and self._skips.hidden  # where no surface has depth, faces turned away hide nothing

    def render(self, camera: Camera, lights: tuple[Light, ...] | None = None) -> Picture:
        """Return the picture seen by `camera`: linear colour, depth, object and shadows of each pixel.

        Args:
            camera: the view.
            lights: in place of the scene's.

        Returns:
            the picture; the next call writes into the same memory, so clone what is to stay.

        Raises:
            SizeError: the picture would need more memory than the limit.
            BackendError: too many lights.
        """
        if self.options.antialias > 1:
            return film.average(lambda c: self._render(c, lights), camera.jittered(self.options.antialias))
        return self._render(camera, lights)

    def _render(self, camera: Camera, lights: tuple[Light, ...] | None) -> Picture:
        start = time.perf_counter()
        picture = self._frame(camera, lights, DETAILS)
        seconds = {"frame": time.perf_counter() - start, **self._seconds}
        self._seconds = {}
        return picture.finished(camera, self._on_device.object_of, self.counts, seconds)

    def show(self, camera: Camera, lights: tuple[Light, ...] | None = None) -> UInt8[Tensor, "height width 4"]:
        """Return what a screen shows of the picture: sRGB of 8 bits, and 255 where an object is seen.

        Arguments, memory and errors as for `render`.
        """
        if self.options.antialias > 1:
            picture = self.render(camera, lights)
            seen = 255 * (picture.owner != -1).to(torch.uint8)
            return torch.cat([torch.from_numpy(image.to_bytes(picture.rgb)), seen[..., None]], -1)
        picture = self._frame(camera, lights, DISPLAY)
        return picture.shown[: camera.height, : camera.width]

    def _frame(self, camera: Camera, lights: tuple[Light, ...] | None, outputs: int) -> "_Picture":
        world = self._on_device.world
        given = lights = world.lit_by(self._on_device.scene.lights if lights is None else lights)
        camera = world.seen_by(camera)
        reaching = [i for i, light in enumerate(lights) if not self._skips.unlit or self._reaches(light)]
        lights = tuple(lights[i] for i in reaching) if len(reaching) < len(lights) else lights
        if len(lights) > MAX_LIGHTS:
            raise BackendError(
                f"opencl: expected at most {MAX_LIGHTS} lights, got {len(lights)}; use the torch backend"
            )
        check_memory("render", camera.width * camera.height * 100.0, MEMORY_LIMIT, "render fewer pixels")
        while True:
            maps, picture = self._room(camera, lights)
            # The device sets the picture's triangles up while the lights' views are found.
            stays = picture.views.aim(
                [camera],
                taken=self._taken,
                frustum=self._skips.frustum,
                cull=self._cull,
                sunk=self._skips.hidden,
                rest=self._skips.resting,
            )
            drawn = maps is not None and self._draw_maps(maps, lights)
            self._draw_picture(picture, camera, lights, outputs)
            counts = picture.views.counts()
            if self._fits(counts + (maps.views.counts() if drawn and maps else [])):
                break
        opencl.read(picture.results[:1] if outputs == DISPLAY else picture.results[1:])
        picture.lit = (len(given), reaching)
        faces = sum(maps.faces) if maps else 0
        self.counts = _named(counts[0], camera) | {
            "lights left out": len(given) - len(reaching),
            "shadow maps drawn": faces if drawn else 0,
            "shadow maps kept": 0 if drawn else faces,
            "shadow stamps left out": maps.views.total("stamps") - maps.views.total("asked") if maps else 0,
            "triangles kept": counts[0]["drawn"] if stays else 0,
            "frames without silhouette code": int(self._plain),
            **self._uploaded,
        }
        self._uploaded = dict.fromkeys(self._uploaded, 0)
        return picture

    def _reaches(self, light: Light) -> bool:
        """Return whether any light falls on any object; in doubt it does."""
        power = light.irradiance if isinstance(light, DirectionalLight) else light.intensity
        if max(power.tolist()) <= 0:
            return False
        if not isinstance(light, SpotLight):
            return True
        balls = self._on_device.geometry.mesh.balls
        centre, radius = balls[:, :3], balls[:, 3]
        way = centre - light.position.double().numpy()
        distance = np.maximum(np.linalg.norm(way, axis=-1), 1e-30)
        off_axis = np.arccos(np.clip(way @ light.axis.double().numpy() / distance, -1, 1))
        seen_under = np.arcsin(np.minimum(radius / distance, 1))
        return bool((off_axis <= np.radians(light.outer_deg) + seen_under + 1e-6).any())

    def milliseconds(self) -> dict[str, float]:
        """Return the time of each kernel in the last frame; of the shadow maps' where they were last drawn."""
        steps: dict[str, float] = {}
        if self._maps is not None:
            steps |= {f"light {name}": call.milliseconds for name, call in self._maps.views.steps.items()}
            steps["light maps"] = sum(call.milliseconds for call in self._maps.draw)
        if self._picture is not None:
            steps |= {name: call.milliseconds for name, call in self._picture.views.steps.items()}
            steps["picture"] = self._picture.draw.milliseconds
        return steps

    @property
    def _taken(self) -> int:
        return self._workers * STAMPS * ROOM

    def _fits(self, counts: list[dict[str, int]]) -> bool:
        """Return whether all layers and cut triangles had room; make more where not."""
        used, slots = max(c["used"] for c in counts), max(c["slots"] for c in counts)
        room = self._picture.views.room_for_cuts() if self._picture else 0
        kept = max(c["kept"] for c in counts)
        if used <= self._taken + self._extra and slots <= room and (self._maps is None or kept <= self._maps.room):
            return True
        self._kept_room = max(self._kept_room, kept + kept // 4)
        self._extra = max(self._extra, 2 * (used - self._taken))
        self._cut_room = max(self._cut_room, slots)
        self._lists = self._picture = self._maps = None
        return False

    def _layers(self) -> "tuple[opencl.Buffer, opencl.Buffer]":
        """Return where the tiles at work keep their layers."""
        if self._lists is None:
            capacity = self._taken + self._extra
            self._lists = opencl.allocate(64 * capacity), opencl.allocate(64 * capacity)
        return self._lists

    def _room(self, camera: Camera, lights: tuple[Light, ...]) -> "tuple[_Maps | None, _Picture]":
        """Return where shadow maps and picture are drawn; the same as before where their sizes are."""
        guess = camera.width * camera.height // 64  # a stamp in four is deeper than it begins with
        if guess > self._extra:
            self._extra, self._lists, self._picture, self._maps = guess, None, None, None
        wanted = ()
        if self.options.shadows:
            wanted = tuple(tuple(shadow_map.sizes(light, self.options.shadow_map_size)) for light in lights)
        if not wanted:
            self._maps = None
        elif self._maps is None or self._maps.sizes != wanted:
            self._maps = self._make_maps(wanted)
        self._light_room = max(self._light_room, len(lights))
        key = (camera.width, camera.height, self._light_room, wanted)
        if self._picture is None or self._picture.key != key:
            self._picture = self._make_picture(key)
        return self._maps, self._picture

    def _draw_maps(self, maps: "_Maps", lights: tuple[Light, ...]) -> bool:
        """Draw the lights' maps, unless they are the same as before."""
        if self._skips.resting and maps.lights is not None and _same(maps.lights, lights):
            return False
        size, corners = self.options.shadow_map_size, self._on_device.corners
        views = [v for light in lights for v in shadow_map.cameras(corners, light, size)]
        maps.lights = lights
        maps.views.aim(views, taken=self._taken, frustum=self._skips.frustum, sunk=self._skips.hidden, before=True)
        for call in maps.draw:
            call()
        return True

    def _views(self, count: int) -> DeviceViews:
        return DeviceViews(self._on_device.geometry.mesh, count, cut_room=self._cut_room)

    def _make_maps(self, sizes: tuple[tuple[int, ...], ...]) -> "_Maps":
        sides = [side for of_light in sizes for side in of_light]
        stamps = sum((-(-side // 4)) ** 2 for side in sides)
        room = max(self._kept_room, 2 * stamps)
        # Empty from the start: where layers find no room a tile stays as it was, and the frame is drawn again.
        stored = (
            opencl.upload(np.zeros((stamps, 2), np.int32)), opencl.allocate(64 * room), opencl.allocate(64 * room),
            opencl.allocate(192 * stamps),
        )  # fmt: skip
        faces = [len(of_light) for of_light in sizes]
        maps = _Maps(views=self._views(len(sides)), stored=stored, room=room, sizes=sizes, faces=faces)
        maps.draw = self._map_calls(maps)
        return maps

    def _map_calls(self, maps: "_Maps") -> list[opencl.Call]:
        """Return the calls that draw each map."""
        views, geometry, materials = maps.views, self._on_device.geometry, self._on_device.materials
        capacity = np.int32(self._taken + self._extra)
        return [
            opencl.Call(
                "render/shadow_map.cl", "draw_light", (self._workers,), (1,),
                (views.views, views.triangles, views.slots, views.labels, views.boxes, views.coarse, views.counters,
                 geometry.records, geometry.facets, materials.tables, materials.mdfs, np.int32(number),
                 np.int32(views.stride), capacity, np.int32(maps.room), np.int32(self._skip_bits()), *self._layers(),
                 *maps.stored, *self._on_device.of_shells),
                self._defines,
            )
            for number in range(views.count)
        ]  # fmt: skip

    def _draw_picture(self, picture: "_Picture", camera: Camera, lights: tuple[Light, ...], outputs: int) -> None:
        """Draw the picture of the camera it is aimed with."""
        scene, maps = self._on_device.scene, self._maps
        if picture.shone is not lights:
            records = picture.lights.array
            records[: max(len(lights), 1)] = device.light_records(lights)
            if maps is not None:
                records["faces"][: len(lights)] = maps.faces
                records["first_face"][: len(lights)] = np.cumsum([0, *maps.faces[:-1]])
            picture.lights.send()
            picture.shone = lights
        frame = picture.frame.array[0]
        frame["lights"], frame["ambient_paper"] = len(lights), scene.ambient_rule == "paper"
        frame["depths"], frame["outputs"] = outputs == DETAILS or maps is not None, outputs
        frame["capacity"], frame["stride"] = self._taken + self._extra, picture.views.stride
        frame["skips"], frame["rank_error"] = self._skip_bits(), self.options.rank_error
        frame["pixel"] = camera.pixel_size / self.options.antialias
        frame["pitch"] = picture.rgba.shape[1]
        frame["ambient"], frame["background"] = scene.ambient, scene.background
        frame["starts"] = 0
        for k, start in enumerate(itertools.islice(self._on_device.starts(camera), MOST_STARTS)):
            frame["start_tet"][k], frame["start_surface"][k], frame["start_place"][k, :3] = start
            frame["starts"] = k + 1
        picture.frame.send()
        if outputs != picture.outputs:
            picture.empty.array[:] = 0
            picture.empty.send()
            picture.outputs = outputs
        picture.draw()

    def _skip_bits(self) -> int:
        """Return the skips as `SKIP_*` in kernels_cl/render/scene.clh."""
        s = self._skips
        return s.empty | s.behind << 1 | s.bounds << 2 | s.losers << 3 | s.facing << 4 | s.unseen << 5

    def _make_picture(self, key: tuple) -> "_Picture":
        width, height, n_light, _ = key
        rows, pitch = -(-height // 4) * 4, -(-width // 4) * 4
        rgba, depth = torch.zeros(rows, pitch, 4), torch.zeros(rows, pitch)
        owner = torch.zeros(rows, pitch, dtype=torch.int32)
        shadowed = torch.zeros(max(n_light, 1), rows, pitch, dtype=torch.uint8)
        shown = torch.zeros(rows, pitch, 4, dtype=torch.uint8)
        results = [(opencl.buffer(x), x) for x in (shown, rgba, depth, owner, shadowed)]
        lights = opencl.Shared(np.zeros(max(n_light, 1), device.LIGHT))
        frame, empty = opencl.Shared(np.zeros(1, FRAME)), opencl.Shared(np.zeros(rows * pitch // 16, np.uint8))
        picture = _Picture(
            key=key, views=self._views(1), results=results, lights=lights, frame=frame, empty=empty,
            shown=shown, rgba=rgba, depth=depth, owner=owner, shadowed=shadowed,
        )  # fmt: skip
        picture.draw = self._picture_call(picture)
        return picture

    def _picture_call(self, picture: "_Picture") -> opencl.Call:
        """Return the call that draws a picture."""
        geometry, materials = self._on_device.geometry, self._on_device.materials
        maps, views = self._maps, picture.views
        lights = maps.views if maps else views
        stored = maps.stored if maps else (views.slots,) * 4  # not read
        return opencl.Call(
            "render/renderer.cl", "draw", (self._workers,), (1,),
            (views.views, views.triangles, views.slots, views.labels, views.boxes, views.coarse, views.counters,
             geometry.records, geometry.facets, materials.tables, materials.mdfs, materials.reflectances,
             picture.lights.buffer, lights.views, lights.slots, lights.labels, lights.counters, *stored,
             picture.frame.buffer, *self._layers(),
             *(b for b, _ in picture.results), picture.empty.buffer, *self._on_device.of_shells),
            (*self._defines, *(["-DSHADOWS"] * self.options.shadows), *(["-DFILTERED"] * self.options.filtering)),
        )  # fmt: skip


class _OnDevice(NamedTuple):
    """A scene and its side on the device."""

    scene: Scene
    world: World
    geometry: device.DeviceGeometry
    materials: device_tables.DeviceMaterials
    corners: Corners
    object_of: list[int]  # of each surface
    shells: device_shell.DeviceShells | None
    gdms: device_gdm.DeviceGdms | None

    def starts(self, camera: Camera) -> Iterator[tuple[int, int, list[float]]]:
        """Yield the tetrahedra that the eye is in, their surfaces, and its texture coordinates there."""
        for placed in self.world.shells if camera.projection == "perspective" else ():
            for tet, place in zip(*shell.around(placed.shell, camera.eye), strict=True):
                yield int(tet) + placed.first_tet, placed.surface, place.tolist()

    @property
    def of_shells(self) -> "tuple[opencl.Buffer, ...]":
        """What kernels are given of them."""
        if self.shells is None or self.gdms is None:
            return ()
        return (*self.shells, self.gdms.tables, self.gdms.gdms)

    @property
    def mixed(self) -> bool:
        """Return whether an interval can have different mesostructures at its ends."""
        return any(len({id(m.mdf) for m in o.materials}) > 1 for o in self.scene.objects)

    def since(self, before: "_OnDevice | None") -> dict[str, int]:
        """Return what was uploaded that was not there before."""
        meshes = before is None or self.geometry is not before.geometry
        return {"faces uploaded": self.geometry.mesh.n_face * meshes, "tables uploaded": self.materials.packed}


def _upload(scene: Scene, options: FrameOptions, before: _OnDevice | None = None) -> _OnDevice:
    """Return `scene` on the device, with what it shares with the one before."""
    materials = device_tables.upload_materials(
        scene.surfaces,
        silhouettes=options.silhouette != "none",
        ambient=scene.ambient > 0,
        before=None if before is None else before.materials,
    )
    gdms = device_gdm.upload_gdms(
        [_dressing(m, options.skips) for m in scene.surfaces], None if before is None else before.gdms
    )
    object_of = [i for i, o in enumerate(scene.objects) for _ in o.materials]
    same = before is not None and _are(_meshes(scene), _meshes(before.scene)) and object_of == before.object_of
    if before is not None and same:
        return before._replace(scene=scene, materials=materials, gdms=gdms)
    world = assemble(scene)
    corners = corners_of(world)
    shells = None
    if world.shells:
        shells = device_shell.upload_shells([(s.shell, s.mesh, s.first_vertex) for s in world.shells])
    return _OnDevice(
        scene, world, device.upload_geometry(world), materials, corners, object_of, shells, gdms if shells else None
    )


def _dressing(material: Material, skips: Skips) -> device_gdm.Dressing | None:
    gdm, form = material.gdm, material.shell
    if gdm is None:
        return None
    bend = device_gdm.BEND * gdm.voxel if skips.carried else 0.0
    return device_gdm.Dressing(gdm, gdm.h, form.queries, form.base == "solid", material.albedo, bend)


@dataclass(eq=False, kw_only=True)
class _Maps:
    """Shadow maps of all lights on the device."""

    views: DeviceViews
    stored: "tuple[opencl.Buffer, ...]"  # passages, their keys and triangles, blockers: of all maps
    room: int  # layers
    draw: list[opencl.Call] = field(init=False)
    sizes: tuple[tuple[int, ...], ...]  # sides of the faces of each light
    faces: list[int]
    lights: tuple[Light, ...] | None = None  # that they were drawn for


@dataclass(eq=False, kw_only=True)
class _Picture:
    """What a frame of one size writes into."""

    key: tuple
    views: DeviceViews
    results: "list[tuple[opencl.Buffer, Tensor]]"
    lights: opencl.Shared
    frame: opencl.Shared
    empty: opencl.Shared
    draw: opencl.Call = field(init=False)
    shown: Tensor
    rgba: Tensor
    depth: Tensor
    owner: Tensor
    shadowed: Tensor
    outputs: int = 0
    shone: tuple[Light, ...] | None = None
    lit: tuple[int, list[int]] = (0, [])

    def finished(
        self, camera: Camera, object_of: list[int], counts: dict[str, int], seconds: dict[str, float]
    ) -> Picture:
        """Return the frame just drawn; kernels count surfaces, `object_of` says whose they are."""
        height, width = camera.height, camera.width
        count, reaching = self.lit
        shadowed = torch.zeros(count, height, width, dtype=torch.bool)
        shadowed[reaching] = self.shadowed[: len(reaching), :height, :width].bool()
        return Picture(
            rgb=self.rgba[:height, :width, :3],
            depth=self.depth[:height, :width],
            owner=torch.tensor([*object_of, -2, -1])[self.owner[:height, :width].long()],
            shadowed=shadowed,
            counts=counts,
            seconds=seconds,
        )


def _meshes(scene: Scene) -> list[object]:
    shells: list[object] = [x for m in scene.surfaces for x in (m.gdm, m.shell)]
    return [*shells, *(x for o in scene.objects for x in (o.mesh, o.part))]


def _depths(scene: Scene) -> list[object]:
    return [m.mdf for m in scene.surfaces]


def _are(a: list[object], b: list[object]) -> bool:
    """Return whether two lists hold the same objects."""
    return len(a) == len(b) and all(map(operator.is_, a, b))


def _same(a: tuple[Light, ...], b: tuple[Light, ...]) -> bool:
    """Return whether two sets of lights are the same, whether or not they are the same objects."""
    return a is b or device.light_records(a).tobytes() == device.light_records(b).tobytes()


def _named(counts: dict[str, int], camera: Camera) -> dict[str, int]:
    """Return the counters under the names of `Picture.counts`."""
    return {
        "triangles drawn": counts["drawn"],
        "fragments": counts["fragments"],
        "layers": counts["deepest"],
        "pixels with a fragment": counts["covered"],
        "pixels": camera.width * camera.height,
        "intervals": counts["intervals"],
        "intervals passed by their length": counts["deep"],
        "intervals passed by the facets alone": counts["bounded"],
        "intervals carved": counts["carved"],
        "pixels inside an object": counts["inside"],
        "depth look-ups": counts["looked"],
        "stretches behind a resolved pixel": counts["hidden"],
        "triangles without a pixel": counts["degenerate"],
        "triangles behind the eye": counts["behind"],
        "stamps that stayed empty": counts["empty"],
        "groups of components spared": counts["spared"],
        "triangles beside the view": counts["beside"],
        "triangles turned away": counts["turned"],
        "losing fragments not shaded": counts["losers"],
        "shadow tests of what leans away": counts["averted"],
        "prisms passed": counts["prisms"],
        "tetrahedra passed": counts["tets"],
        "rays lost in a shell": counts["endless"],
        "prisms passed without a look-up": counts["carried"],
    }
