"""Rows of the suite `gdm` on distortion: how a base mesh bends a weave, by a GDM and by a VDM, ever finer.

A GDM's ways are straight in each prism, so its error falls with the prisms' size. A VDM is asked once at the surface,
with one curvature for all of the way; finer meshes tell it that curvature better.

Test: tests/bench/test_gdm_distortion.py
"""

from collections.abc import Iterator

from torchmeso.bench.gdm_speed import LIGHT, SIZE, camera_entries, table, view
from torchmeso.bench.gdm_vdm import weave_vdm
from torchmeso.bench.suite import Context, Row
from torchmeso.bench.vdm_frame import VdmFrames
from torchmeso.geometry import shapes
from torchmeso.geometry.mesh import Mesh, dress
from torchmeso.geometry.rays import RayScene
from torchmeso.meso import generators
from torchmeso.meso.bake_gdm import GdmOptions
from torchmeso.meso.displace import displace
from torchmeso.render import device_gdm
from torchmeso.render.device_trace import DeviceTrace

BODIES = {
    "flat": lambda n: shapes.plane(triangles=n),
    "cylinder": lambda n: shapes.cylinder(radius=0.7, height=1.6, tiles=(6, 2), triangles=n),
    "saddle": lambda n: saddle(n),
    "sphere": lambda n: shapes.sphere(triangles=n, tiles=(6, 3)),
    "torus": lambda n: shapes.torus(triangles=n, tiles=(5, 2)),
}

LEAST = 500
"""Triangles of the coarsest mesh."""


def distortion(context: Context) -> Iterator[Row]:
    """Base meshes ever finer: how far rays end from where they do on the finest, laid over it as triangles.

    The rays are those that both maps and the truth let meet material.
    """
    gdm = table("weave", GdmOptions(texels=64, layers=32), context, backing=True)
    for name, body in BODIES.items():
        twin = displace(body(16 * LEAST), generators.weave(backing=True), max_edge=0.05)
        scene = RayScene(twin.vertices, twin.faces)
        for factor in (1, 4) if context.quick else (1, 4, 16):
            mesh, camera = body(LEAST * factor), view()
            built, entries, pixel = camera_entries(mesh, gdm.h, camera)
            truth = scene.first_hit(entries.origin.float(), entries.direction.float())
            traced = DeviceTrace(built, mesh, gdm, bend=device_gdm.BEND * gdm.voxel).trace(entries)
            frames = VdmFrames(mesh, weave_vdm(), gdm, camera, LIGHT)
            frames.draw(camera)
            start = (entries.origin - camera.eye.double()).norm(dim=1)
            looked = frames.seen.t.reshape(SIZE * SIZE)[pixel].double() - start
            both = traced.hit & (truth.face >= 0) & looked.isfinite()
            for kind, t in {"GDM": traced.t, "VDM": looked}.items():
                off = (t - truth.t.double()).abs()[both] / float(mesh.scale.mean())
                yield Row(
                    id=f"distortion.{name}.{kind.lower()}.{factor}", unit="tile units", better="lower", n=len(off),
                    what=f"{name} of {len(mesh.faces)} triangles, {kind}: median error of where rays end, beside the "
                    "finest",
                    value=round(float(off.median()), 5), curve={"series": kind, "x": factor, "y": "median"},
                )  # fmt: skip


def saddle(triangles: int) -> Mesh:
    """Return a sheet that bends up along x and down along z, by radii of 1."""
    sheet = shapes.plane(triangles=triangles)
    vertices = sheet.vertices.clone()
    vertices[:, 1] = 0.5 * (vertices[:, 0].square() - vertices[:, 2].square())
    return dress(vertices, sheet.faces, sheet.uv)
