"""Cameras from pictures of a flat board: zhang2000flexible.

A board's plane z = 0 goes to the picture by a homography H = K [r1 r2 t] as long as the lens does not bend it. Two
equations per board, h1^T B h2 = 0 and h1^T B h1 = h2^T B h2 with B = K^-T K^-1, give K in closed form (section 3.1);
the poses follow, and all parameters are refined by Levenberg-Marquardt on the distances in the picture, with the lens
of `data.calibration` (section 3.3, tangential terms added).

Board and picture points are matched by index. Pixel centres are at (i + 0.5).

Test: tests/capture/test_calibrate.py
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.algebra import levenberg
from torchmeso.data.calibration import CalibratedCamera, distort, to_pixels
from torchmeso.errors import GeometryError, ShapeError, check_finite, check_shape

INTRINSIC = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
"""Order of a camera's own parameters; the skew is 0."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Calibration:
    """A camera and the boards it saw.

    Attributes:
        cameras: one per board, the same lens at the place it has in that board's frame.
        rms: root mean square distance of seen from projected corners, pixels.
        residuals: (board, n, 2) projected minus seen, pixels.
        sigma: standard deviation of fx, fy, cx, cy (pixels), k1, k2, p1, p2, k3.
    """

    cameras: tuple[CalibratedCamera, ...]
    rms: float
    residuals: Float[Tensor, "board n 2"]
    sigma: Float[Tensor, "9"]


def calibrate(board: Float[Tensor, "n 2"], seen: Float[Tensor, "board n 2"], *, width: int, height: int) -> Calibration:
    """Return the camera that saw the corners `board` at `seen`.

    Args:
        board: (n, 2) corners on the board, in the rig's unit of length.
        seen: (board, n, 2) the same corners in each picture, pixels.
        width: of the pictures, pixels.
        height: of the pictures, pixels.

    Raises:
        ShapeError: no boards, or points that do not match.
        GeometryError: the boards are all parallel to each other, or too few.
    """
    check_shape("board", board, (-1, 2))
    check_shape("seen", seen, (-1, len(board), 2))
    if len(seen) < 2:
        raise ShapeError(f"boards: expected at least 2 pictures, got {len(seen)}; 10 or more in many poses are better")
    if len(board) < 4:
        raise ShapeError(f"board: expected at least 4 corners, got {len(board)}")
    check_finite("seen", seen)
    board, seen = board.double(), seen.double()
    H = homographies(board.expand(len(seen), -1, -1), seen)
    K = intrinsics_from_homographies(H, width, height)
    start = torch.cat([torch.stack([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]), torch.zeros(5), poses(H, K).flatten()])

    def residuals(x: Tensor) -> Tensor:
        return (project_board(board, x[:9], x[9:].view(-1, 6)) - seen).flatten()

    found = levenberg.minimise(residuals, start.double())
    if bool(found.covariance.isinf().any()):
        raise GeometryError("boards: expected poses that fix the camera, got too few or parallel ones; tilt the board")
    K, pose = intrinsic_matrix(found.x), found.x[9:].view(-1, 6)
    return Calibration(
        cameras=tuple(
            CalibratedCamera(K=K, distortion=found.x[4:9], R=rotation(p[:3]), t=p[3:], width=width, height=height)
            for p in pose
        ),
        rms=float((found.residuals.square().sum() / seen[..., 0].numel()).sqrt()),
        residuals=found.residuals.view(seen.shape),
        sigma=found.covariance.diagonal()[:9].sqrt(),
    )


def project_board(
    board: Float[Tensor, "n 2"], intrinsic: Float[Tensor, "9"], pose: Float[Tensor, "board 6"]
) -> Float[Tensor, "board n 2"]:
    """Return the pixels of the corners at each pose (rotation vector, translation)."""
    R = rotation(pose[:, :3])
    X = board @ R[..., :2].mT + pose[:, None, 3:]
    return to_pixels(distort(X[..., :2] / X[..., 2:], intrinsic[4:]), intrinsic_matrix(intrinsic))


def intrinsic_matrix(intrinsic: Float[Tensor, "n"]) -> Float[Tensor, "3 3"]:
    """Return K of fx, fy, cx, cy, ... without skew."""
    fx, fy, cx, cy = intrinsic[:4]
    zero, one = torch.zeros_like(fx), torch.ones_like(fx)
    return torch.stack([fx, zero, cx, zero, fy, cy, zero, zero, one]).view(3, 3)


def rotation(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the rotations by |v| radians about v; differentiable everywhere."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    # Rodrigues; the root is kept from 0, where its derivative is infinite.
    angle = (vector.square().sum(-1) + 1e-30).sqrt()[..., None, None]
    one, two = torch.sinc(angle / math.pi), 0.5 * torch.sinc(0.5 * angle / math.pi).square()
    return torch.eye(3, dtype=vector.dtype) + one * cross + two * (cross @ cross)


def rotation_vector(R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Return the axis times the angle in radians, 0 to pi, of rotations."""
    skew = torch.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], -1)
    cosine = 0.5 * (R.diagonal(dim1=-2, dim2=-1).sum(-1) - 1)
    angle = torch.atan2(0.5 * skew.norm(dim=-1), cosine)
    # At half a turn the skew part vanishes, and the axis is the longest column of R + 1.
    columns = R + torch.eye(3, dtype=R.dtype)
    longest = columns.norm(dim=-2).argmax(-1)
    axis = columns.gather(-1, longest[..., None, None].expand(*longest.shape, 3, 1)).squeeze(-1)
    axis = axis * torch.where((axis * skew).sum(-1, keepdim=True) < 0, -1.0, 1.0)
    small = skew.norm(dim=-1, keepdim=True) < 1e-6
    turned = torch.where(small & (cosine < 0)[..., None], axis, skew)
    unit = turned / turned.norm(dim=-1, keepdim=True).clamp(min=1e-300)
    return angle[..., None] * unit


def homographies(source: Float[Tensor, "b n 2"], target: Float[Tensor, "b n 2"]) -> Float[Tensor, "b 3 3"]:
    """Return the maps of homogeneous points source -> target, by the direct linear transform on normalised points."""
    p, to_p = _normalised(source)
    q, to_q = _normalised(target)
    zero = torch.zeros_like(p)
    rows = torch.cat([torch.cat([p, zero, -q[..., :1] * p], -1), torch.cat([zero, p, -q[..., 1:2] * p], -1)], 1)
    H = torch.linalg.svd(rows).Vh[:, -1].view(-1, 3, 3)
    H = torch.linalg.solve(to_q, H @ to_p)
    return H / H[:, 2:, 2:]


def intrinsics_from_homographies(H: Float[Tensor, "b 3 3"], width: int, height: int) -> Float[Tensor, "3 3"]:
    """Return K without skew in closed form; the picture's centre is taken as c where the boards do not fix it.

    Raises:
        GeometryError: the boards are parallel.
    """
    size = float(max(width, height))
    N = torch.tensor([[1 / size, 0, -width / 2 / size], [0, 1 / size, -height / 2 / size], [0, 0, 1]]).to(H)
    h = N @ H
    h = h / h.norm(dim=(1, 2), keepdim=True)

    def v(i: int, j: int) -> Tensor:  # of B11, B22, B13, B23, B33; B12 = 0
        a, b = h[..., i], h[..., j]
        return torch.stack(
            [a[:, 0] * b[:, 0], a[:, 1] * b[:, 1], a[:, 0] * b[:, 2] + a[:, 2] * b[:, 0],
             a[:, 1] * b[:, 2] + a[:, 2] * b[:, 1], a[:, 2] * b[:, 2]], -1
        )  # fmt: skip

    rows = torch.cat([v(0, 1), v(0, 0) - v(1, 1)])
    if len(H) > 2:
        s, vh = torch.linalg.svd(rows)[1:]
        b11, b22, b13, b23, b33 = (vh[-1] * vh[-1].sum().sign()).unbind()
        scale = b33 - b13.square() / b11 - b23.square() / b22
        fx2, fy2, cx, cy = scale / b11, scale / b22, -b13 / b11, -b23 / b22
        if float(s[3]) > 1e-7 * float(s[0]) and float(fx2) > 0 and float(fy2) > 0:
            return _unscaled(fx2.sqrt(), fy2.sqrt(), cx, cy, N)
    # c in the middle: B = diag(b11, b22, 1) fixes the focal lengths by least squares.
    solved = torch.linalg.lstsq(rows[:, :2], -rows[:, 4:]).solution.squeeze(1)
    if not bool((solved > 1e-9).all()):
        raise GeometryError("boards: expected boards tilted against each other, got parallel ones; tilt the board")
    zero = torch.zeros_like(solved[0])
    return _unscaled(solved[0].rsqrt(), solved[1].rsqrt(), zero, zero, N)


def _unscaled(fx: Tensor, fy: Tensor, cx: Tensor, cy: Tensor, N: Tensor) -> Tensor:
    return torch.linalg.solve(N, intrinsic_matrix(torch.stack([fx, fy, cx, cy])))


def poses(H: Float[Tensor, "b 3 3"], K: Float[Tensor, "3 3"]) -> Float[Tensor, "b 6"]:
    """Return rotation vector and translation of boards in the camera's frame, all in front of it."""
    a = torch.linalg.solve(K, H)
    a = a / (0.5 * (a[..., 0].norm(dim=-1) + a[..., 1].norm(dim=-1)))[:, None, None]
    a = a * torch.where(a[:, 2:, 2:] < 0, -1.0, 1.0)
    frame = torch.stack([a[..., 0], a[..., 1], torch.linalg.cross(a[..., 0], a[..., 1])], -1)
    u, _, vh = torch.linalg.svd(frame)
    return torch.cat([rotation_vector(u @ vh), a[..., 2]], -1)


def _normalised(points: Tensor) -> tuple[Tensor, Tensor]:
    """Return homogeneous points of mean 0 and size 1, and the maps that made them."""
    mean = points.mean(1)
    size = (points - mean[:, None]).norm(dim=-1).mean(1).clamp(min=1e-12)
    N = torch.zeros(len(points), 3, 3, dtype=points.dtype)
    N[:, 0, 0] = N[:, 1, 1] = 1 / size
    N[:, :2, 2] = -mean / size[:, None]
    N[:, 2, 2] = 1
    return torch.cat([points, torch.ones_like(points[..., :1])], -1) @ N.mT, N


def find_corners(pictures: Sequence[Tensor], columns: int, rows: int) -> Float[Tensor, "board n 2"]:
    """Return the inner corners of a checkerboard in grey 8-bit `pictures`; NaN where a picture shows none.

    Needs OpenCV (extra `rig`). Corners go row by row, as OpenCV orders them.

    Raises:
        GeometryError: OpenCV is absent, or no picture shows the board.
    """
    try:
        import cv2
    except ImportError as error:
        raise GeometryError("corners: expected OpenCV, which is absent; install torchmeso[rig]") from error
    found = torch.full((len(pictures), columns * rows, 2), torch.nan, dtype=torch.float64)
    for i, picture in enumerate(pictures):
        seen, corners = cv2.findChessboardCornersSB(picture.numpy(), (columns, rows), flags=cv2.CALIB_CB_ACCURACY)
        if seen:
            found[i] = torch.from_numpy(corners).reshape(-1, 2) + 0.5
    if bool(found.isnan().all()):
        raise GeometryError(f"corners: no board of {columns} x {rows} inner corners in {len(pictures)} pictures")
    return found


def laser_angle(offset: float, height: float) -> float:
    """Return the angle of the laser plane to the reference plane, radians, from two planes of known height.

    wang2005mdf, section 3.2: on a plane `height` above another the strip lies `offset` away, across the strip.

    Raises:
        GeometryError: the planes have one height.
    """
    if height == 0:
        raise GeometryError("laser angle: expected two planes of different height, got 0 between them")
    return math.atan2(abs(height), abs(offset))


def fit_plane(points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "4"], float]:
    """Return the plane (n, d), n . x = d, nearest to `points` in the least-squares sense, and the rms distance.

    Raises:
        GeometryError: the points lie on a line, or are fewer than three.
    """
    if len(points) < 3:
        raise GeometryError(f"plane: expected at least 3 points, got {len(points)}")
    mean = points.mean(0)
    _, s, vh = torch.linalg.svd(points - mean, full_matrices=False)
    if float(s[1]) < 1e-6 * float(s[0]):
        raise GeometryError("plane: expected points off one line, got collinear ones; show the laser at other depths")
    return torch.cat([vh[2], (vh[2] @ mean).unsqueeze(0)]), float(s[2]) / len(points) ** 0.5
