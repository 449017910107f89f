"""Frame after frame on OpenCL: nothing is made again that did not change.

    set up the camera's triangles -> [set up and draw the lights' maps] -> fill, test and shade tiles

A new light draws its shadow map again, a new camera only the picture. In a new scene, meshes are uploaded again when
one of them changed, a BTF or an MDF when it was not there before, and shadow maps are drawn again when a mesh or an MDF
changed. The torch frame (`frame.render`) is the formula of all of this.

Kernels: kernels_cl/render/renderer.cl, kernels_cl/render/shadow_map.cl          Test: tests/render/test_renderer.py
"""

import itertools
import time
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from torchmeso.backends import opencl
from torchmeso.data import image
from torchmeso.errors import BackendError, check_memory
from torchmeso.geometry.camera import Camera
from torchmeso.geometry.light import Light
from torchmeso.render import device, film, reach, shadow_map
from torchmeso.render.device_picture import DETAILS, DISPLAY, MOST_STARTS, DevicePicture, named
from torchmeso.render.device_raster import ROOM, STAMPS, DeviceViews
from torchmeso.render.device_scene import are, depths, upload_scene
from torchmeso.render.film import Picture
from torchmeso.render.frame import MEMORY_LIMIT, FrameOptions
from torchmeso.render.scene import Scene

MAX_LIGHTS = 64
"""Of a frame, as in kernels_cl/render/shadow_map.clh."""


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
        self._picture: DevicePicture | None = None
        self._maps: _Maps | None = None
        self.counts: dict[str, int] = {}
        self._on_device = upload_scene(scene, self.options)
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
        before, self._on_device = self._on_device, upload_scene(scene, self.options, self._on_device)
        self._choose_code()
        moved = self._on_device.geometry is not before.geometry
        if self._maps is not None:
            if moved:
                self._maps.views = self._views(self._maps.views.count)
            if moved or not are(depths(scene), depths(before.scene)):
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
        distant = self._on_device.distant
        self._distant = ("-DDISTANT",) if distant else ()
        self._distant += ("-DTRANSFER",) if distant and distant.field else ()
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
            BackendError: too many lights for ambient light that shows only in shadow.
        """
        if self.options.antialias > 1:
            return film.average(lambda c: self._render(c, lights), camera.jittered(self.options.antialias))
        return self._render(camera, lights)

    def _render(self, camera: Camera, lights: tuple[Light, ...] | None) -> Picture:
        given = self._on_device.scene.lights if lights is None else lights
        if len(given) <= MAX_LIGHTS:
            return self._pass(camera, lights)
        if self._on_device.scene.ambient_rule == "paper":
            raise BackendError(
                f"opencl: expected at most {MAX_LIGHTS} lights where ambient light shows only in shadow, "
                f"got {len(given)}; use the torch backend"
            )
        parts = [given[i : i + MAX_LIGHTS] for i in range(0, len(given), MAX_LIGHTS)]
        return film.total(self._pass(camera, part, further=i > 0) for i, part in enumerate(parts))

    def _pass(self, camera: Camera, lights: tuple[Light, ...] | None, *, further: bool = False) -> Picture:
        """Return the picture under lights that one kernel can hold; `further` ones leave out what is no light's."""
        start = time.perf_counter()
        picture = self._frame(camera, lights, DETAILS, further=further)
        seconds = {"frame": time.perf_counter() - start, **self._seconds}
        self._seconds = {}
        return picture.finished(camera, self._on_device.object_of, self.counts, seconds)

    def show(self, camera: Camera, lights: tuple[Light, ...] | None = None) -> UInt8[Tensor, "height width 4"]:
        """Return what a screen shows of the picture: sRGB of 8 bits, and 255 where an object is seen.

        Arguments, memory and errors as for `render`.
        """
        many = len(self._on_device.scene.lights if lights is None else lights) > MAX_LIGHTS
        if self.options.antialias > 1 or many:
            picture = self.render(camera, lights)
            seen = 255 * (picture.owner != -1).to(torch.uint8)
            return torch.cat([torch.from_numpy(image.to_bytes(picture.rgb)), seen[..., None]], -1)
        picture = self._frame(camera, lights, DISPLAY)
        return picture.shown[: camera.height, : camera.width]

    def _frame(
        self, camera: Camera, lights: tuple[Light, ...] | None, outputs: int, *, further: bool = False
    ) -> DevicePicture:
        world = self._on_device.world
        given = lights = world.lit_by(self._on_device.scene.lights if lights is None else lights)
        camera = world.seen_by(camera)
        reached = list(range(len(lights)))
        if self._skips.unlit:
            reached = reach.reaching(lights, self._on_device.scene, self._on_device.geometry.mesh.balls)
        lights = tuple(lights[i] for i in reached) if len(reached) < len(lights) else lights
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
            self._draw_picture(picture, camera, lights, outputs, further)
            counts = picture.views.counts()
            if self._fits(counts + (maps.views.counts() if drawn and maps else [])):
                break
        opencl.read(picture.results[:1] if outputs == DISPLAY else picture.results[1:])
        picture.lit = (len(given), reached)
        faces = sum(maps.faces) if maps else 0
        self.counts = named(counts[0], camera) | {
            "lights left out": len(given) - len(reached),
            "shadow maps drawn": faces if drawn else 0,
            "shadow maps kept": 0 if drawn else faces,
            "shadow stamps left out": maps.views.total("stamps") - maps.views.total("asked") if maps else 0,
            "triangles kept": counts[0]["drawn"] if stays else 0,
            "frames without silhouette code": int(self._plain),
            **self._uploaded,
        }
        self._uploaded = dict.fromkeys(self._uploaded, 0)
        return picture

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

    def _room(self, camera: Camera, lights: tuple[Light, ...]) -> "tuple[_Maps | None, DevicePicture]":
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
            self._picture = DevicePicture.make(key, self._views(1))
            self._picture.draw = self._picture_call(self._picture)
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

    def _draw_picture(
        self, picture: DevicePicture, camera: Camera, lights: tuple[Light, ...], outputs: int, further: bool
    ) -> None:
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
        frame["ambient"], frame["background"] = 0.0 if further else scene.ambient, scene.background
        frame["starts"] = 0
        frame["distant_degree"] = self._on_device.distant.degree if self._on_device.distant and not further else -1
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

    def _picture_call(self, picture: DevicePicture) -> opencl.Call:
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
             *(b for b, _ in picture.results), picture.empty.buffer, *self._on_device.of_shells,
             *self._on_device.of_distant),
            (*self._defines, *self._distant, *(["-DSHADOWS"] * self.options.shadows),
             *(["-DFILTERED"] * self.options.filtering)),
        )  # fmt: skip


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


def _same(a: tuple[Light, ...], b: tuple[Light, ...]) -> bool:
    """Return whether two sets of lights are the same, whether or not they are the same objects."""
    return a is b or device.light_records(a).tobytes() == device.light_records(b).tobytes()
