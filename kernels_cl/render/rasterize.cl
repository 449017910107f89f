// The rasteriser's kernels: triangles, those that are cut, and tiles.
// Host: torchmeso/render/device_raster.py; the formula: torchmeso/render/rasterize.py

#include "render/rasterize.clh"

#pragma OPENCL FP_CONTRACT OFF

static INNER void set_up_part(const int part, const int number, __global const View *restrict views,
                              __global const double *restrict vertices, __global const int *restrict faces,
                              __global const int2 *restrict tags, __global Triangle *restrict triangles,
                              __global Slot *restrict slots, __global Label *restrict labels,
                              __global int *restrict boxes, __global int *restrict coarse,
                              __global uchar *restrict crossing, __global Counters *restrict counters,
                              __global const Box *restrict objects, const int count, const int padded,
                              const int stride)
{
    __global const View *view = views + number;
    __global Counters *counted = counters + number;
    const int coarse_stride = ((stride >> 4) + 15) & ~15;
    __global int *box_of = boxes + 4 * view->slots;
    __global int *coarse_of = coarse + number * 4 * coarse_stride;
    int object = -1, place = 0, near_bodies = 0;
    int drawn = 0, degenerate = 0, turned = 0, aside = 0, crossed = 0, behind = 0;
    for (int v = VECTORS * part; v < MIN(VECTORS * (part + 1), padded >> 4); v++) {
        const int s = view->slots + 16 * v;
        const int lanes = (1 << MIN(16, count - 16 * v)) - 1;
        int hidden = 0, beside = 0, sunk = 0;
        for (int rest = lanes; rest; rest &= rest - 1) {
            const int lane = __builtin_ctz(rest);
            const int2 tag = tags[16 * v + lane];
            labels[s + lane].face = 16 * v + lane;
            labels[s + lane].tag = tag.x & ~SUNK;
            const int own = tag.y < 0 ? ~tag.y : tag.y;
            if (own != object) {
                object = own;
                place = overlap(view, objects + object);
                near_bodies |= place & AROUND && objects[object].body;
            }
            beside |= (place & BESIDE && view->frustum) << lane;
            sunk |= (tag.x & SUNK && view->sunk && !(place & AROUND)) << lane;
            hidden |= (tag.y < 0 || (view->cull && tag.x & CLOSED && !(place & AROUND))) << lane;
        }
        aside += __builtin_popcount(beside);
        turned += __builtin_popcount(sunk & ~beside);
        const int asked = lanes & ~beside & ~sunk;
        if (!asked) {
            *(__global uchar16 *)(crossing + number * padded + 16 * v) = 0;
            for (int k = 0; k < 4; k++) {
                *(__global int16 *)(box_of + k * stride + 16 * v) = LIMIT;
                coarse_of[k * coarse_stride + v] = LIMIT;
            }
            continue;
        }
        Corners corners;
        int ahead = 0, whole = asked;
        for (int k = 0; k < 3; k++) {
            Doubles point[3] = {{0.0}, {0.0}, {0.0}};
            for (int rest = asked; rest; rest &= rest - 1) {
                const int lane = __builtin_ctz(rest);
                __global const double *p = vertices + 3 * faces[3 * (16 * v + lane) + k];
                point[0].lane[lane] = p[0], point[1].lane[lane] = p[1], point[2].lane[lane] = p[2];
            }
            const Projected p = project(view, point);
            const double16 x = p.x.vector / p.w.vector, y = p.y.vector / p.w.vector;
            const int before = to_bits(TO_INT(p.depth.vector >= view->near));
            const int16 within = TO_INT((x <= GUARD_BAND) & (x >= -GUARD_BAND) &
                                        (y <= GUARD_BAND) & (y >= -GUARD_BAND));
            corners.x[k].vector = within ? snap(x) : (int16)0;
            corners.y[k].vector = within ? snap(y) : (int16)0;
            corners.q[k].vector = view->perspective ? 1.0 / p.w.vector : p.depth.vector;
            ahead |= before;
            whole &= before & to_bits(within);
        }
        const int crosses = asked & ahead & ~whole;
        Planes planes;
        const int made = set_up_triangles(view, &corners, whole, hidden, triangles + s, &planes);
        keep_planes(triangles + s, slots + s, made, &planes);
        for (int rest = made & planes.front; rest; rest &= rest - 1) labels[s + __builtin_ctz(rest)].tag |= FRONT;
        *(__global uchar16 *)(crossing + number * padded + 16 * v) =
            __builtin_convertvector(from_bits(crosses), uchar16);
        for (int k = 0; k < 4; k++) {
            *(__global int16 *)(box_of + k * stride + 16 * v) = planes.box[k].vector;
            int least = LIMIT;
            for (int lane = 0; lane < 16; lane++) least = MIN(least, planes.box[k].lane[lane]);
            coarse_of[k * coarse_stride + v] = least;
        }
        drawn += __builtin_popcount(made);
        degenerate += __builtin_popcount(whole & ~made & ~planes.turned);
        turned += __builtin_popcount(planes.turned);
        crossed += __builtin_popcount(crosses);
        behind += __builtin_popcount(asked & ~ahead);
    }
    if (near_bodies) counted->near_bodies = 1;
    if (drawn) atomic_add(&counted->drawn, drawn);
    if (degenerate) atomic_add(&counted->degenerate, degenerate);
    if (turned) atomic_add(&counted->turned, turned);
    if (aside) atomic_add(&counted->beside, aside);
    if (crossed) atomic_add(&counted->crossing, crossed);
    if (behind) atomic_add(&counted->behind, behind);
}

// Sets up 16 VECTORS faces for one view. `slots` triangles of a view stand together, cut ones behind the others.
__kernel void set_up(__global const View *restrict views, __global const double *restrict vertices,  // (V, 3)
                     __global const int *restrict faces,   // (F, 3)
                     __global const int2 *restrict tags,   // (F) component << 2 | CLOSED | SUNK; object, ~ of it where a
                                                           // face is only there for rays that meet its front
                     __global Triangle *restrict triangles, __global Slot *restrict slots,
                     __global Label *restrict labels,
                     __global int *restrict boxes,         // (4, slots) per view: low x, low y, -high x, -high y
                     __global int *restrict coarse,        // (4, slots / 16)
                     __global uchar *restrict crossing,    // (padded faces) per view
                     __global Counters *restrict counters,
                     __global const Box *restrict objects, const int count, const int padded, const int stride)
{
    set_up_part(get_global_id(0), get_global_id(1), views, vertices, faces, tags, triangles, slots, labels, boxes,
                coarse, crossing, counters, objects, count, padded, stride);
}

typedef struct {
    double at[4], share[3];  // x w, y w, w, depth; barycentric coordinates in the whole triangle
} Corner;

// Cuts a polygon where `distance` = near, or one side of the guard band, is negative. Cut points are computed from the
// corner inside, so that triangles that share an edge are cut at the same place, bit for bit.
static int cut(Corner *corner, const int count, const int plane, const double near)
{
    Corner kept[9];
    double distance[9];
    int n = 0;
    for (int k = 0; k < count; k++) {
        const double w = corner[k].at[2] * GUARD_BAND;
        distance[k] = plane == 0 ? corner[k].at[3] - near
                    : plane == 1 ? corner[k].at[0] + w
                    : plane == 2 ? w - corner[k].at[0]
                    : plane == 3 ? corner[k].at[1] + w
                                 : w - corner[k].at[1];
    }
    for (int k = 0; k < count; k++) {
        const int next = k + 1 < count ? k + 1 : 0;
        const int inside = distance[k] >= 0, inside_next = distance[next] >= 0;
        if (inside) kept[n++] = corner[k];
        if (inside != inside_next) {
            const int from = inside ? k : next, to = inside ? next : k;
            const double share = distance[from] / (distance[from] - distance[to]);
            for (int c = 0; c < 4; c++)
                kept[n].at[c] = corner[from].at[c] + share * (corner[to].at[c] - corner[from].at[c]);
            for (int c = 0; c < 3; c++)
                kept[n].share[c] = corner[from].share[c] + share * (corner[to].share[c] - corner[from].share[c]);
            n++;
        }
    }
    for (int k = 0; k < n; k++) corner[k] = kept[k];
    return n;
}

// Cuts the faces that cross the near plane or the guard band; one work-item per view, so that the order of triangles is
// always the same.
__kernel void cut_faces(__global const View *restrict views, __global const double *restrict vertices,
                        __global const int *restrict faces, __global const int2 *restrict tags,
                        __global Triangle *restrict triangles, __global Slot *restrict slots,
                        __global Label *restrict labels, __global int *restrict boxes, __global int *restrict coarse,
                        __global const uchar *restrict crossing, __global Counters *restrict counters,
                        const int count, const int padded, const int stride)
{
    const int number = get_global_id(0);
    __global const View *view = views + number;
    __global Counters *counted = counters + number;
    const int coarse_stride = ((stride >> 4) + 15) & ~15;
    __global int *box_of = boxes + 4 * view->slots;
    __global int *coarse_of = coarse + number * 4 * coarse_stride;
    int n = 0;
    if (counted->crossing) {
        for (int f = 0; f < count; f++) {
            if (!crossing[number * padded + f]) continue;
            Corner corner[9];
            Doubles point[3] = {{0.0}, {0.0}, {0.0}};
            for (int k = 0; k < 3; k++)
                for (int c = 0; c < 3; c++) point[c].lane[k] = vertices[3 * faces[3 * f + k] + c];
            const Projected p = project(view, point);
            for (int k = 0; k < 3; k++) {
                corner[k].at[0] = p.x.lane[k], corner[k].at[1] = p.y.lane[k];
                corner[k].at[2] = p.w.lane[k], corner[k].at[3] = p.depth.lane[k];
                for (int c = 0; c < 3; c++) corner[k].share[c] = c == k;
            }
            int corners = 3;
            for (int plane = 0; plane < 5 && corners; plane++) corners = cut(corner, corners, plane, view->near);
            // The pieces fan out from the first corner, at most seven of them.
            const int pieces = MAX(corners - 2, 0), fits = MIN(pieces, stride - padded - n);
            const int s = view->slots + padded + n;
            n += pieces;
            if (fits <= 0) continue;  // the host gives more room and asks again
            Corners on_screen;
            Doubles x[3], y[3];
            for (int l = 0; l < 16; l++) {
                const int piece = MIN(l, pieces - 1), fan[3] = {0, piece + 1, piece + 2};
                for (int c = 0; c < 3; c++) {
                    const Corner *at = corner + fan[c];
                    x[c].lane[l] = at->at[0] / at->at[2];
                    y[c].lane[l] = at->at[1] / at->at[2];
                    on_screen.q[c].lane[l] = view->perspective ? 1.0 / at->at[2] : at->at[3];
                }
            }
            for (int c = 0; c < 3; c++) {
                on_screen.x[c].vector = snap(x[c].vector);
                on_screen.y[c].vector = snap(y[c].vector);
            }
            Planes planes;
            // The eye may be inside: nothing is left out.
            const int drawn = set_up_triangles(view, &on_screen, (1 << fits) - 1, 0, triangles + s, &planes);
            for (int rest = drawn; rest; rest &= rest - 1) {
                // From the piece's own corners to those of the face.
                const int l = __builtin_ctz(rest), fan[3] = {0, l + 1, l + 2};
                Doubles *rows[3] = {planes.at, planes.x, planes.y};
                for (int r = 0; r < 3; r++) {
                    double share[3] = {0, 0, 0};
                    for (int c = 0; c < 3; c++)
                        for (int j = 0; j < 3; j++) share[j] += rows[r][c].lane[l] * corner[fan[c]].share[j];
                    for (int j = 0; j < 3; j++) rows[r][j].lane[l] = share[j];
                }
            }
            keep_planes(triangles + s, slots + s, drawn, &planes);
            counted->drawn += __builtin_popcount(drawn);
            for (int l = 0; l < fits; l++) {
                labels[s + l].face = f;
                labels[s + l].tag = (tags[f].x & ~SUNK) | (planes.front >> l & FRONT);
                for (int b = 0; b < 4; b++) box_of[b * stride + padded + n - pieces + l] = planes.box[b].lane[l];
            }
        }
    }
    counted->slots = n;
    const int last = MIN(padded + n, stride), vectors = (last + 15) >> 4;
    for (int f = last; f < 16 * vectors; f++)
        for (int b = 0; b < 4; b++) box_of[b * stride + f] = LIMIT;
    for (int v = padded >> 4; v < vectors; v++) {
        for (int b = 0; b < 4; b++) {
            int least = LIMIT;
            for (int lane = 0; lane < 16; lane++) least = MIN(least, box_of[b * stride + 16 * v + lane]);
            coarse_of[b * coarse_stride + v] = least;
        }
    }
    for (int v = vectors; v < ((vectors + 15) & ~15); v++)
        for (int b = 0; b < 4; b++) coarse_of[b * coarse_stride + v] = LIMIT;
    counted->vectors = vectors;
}

#pragma OPENCL FP_CONTRACT ON

// All fragments of a picture. Each work-item takes tile after tile until none is left.
static INNER void fill_all_tiles(const int worker, __global const View *restrict view,
                                 __global const Triangle *restrict triangles, __global const int16 *restrict boxes,
                                 __global const int16 *restrict coarse, __global Counters *restrict counters,
                                 const int stride, const int capacity, __global int *restrict begin,
                                 __global int *restrict layers, __global float16 *restrict key,
                                 __global int16 *restrict slot)
{
    const int across = (view->width + TILE - 1) / TILE, down = (view->height + TILE - 1) / TILE;
    const int stamps_across = (view->width + 3) >> 2;
    Lists lists;
    while (1) {
        const int tile = atomic_inc(&counters->tile);
        if (tile >= across * down) return;
        const int x0 = tile % across * TILE, y0 = tile / across * TILE;
        if (!fill_tile(view, triangles, boxes, coarse, counters->vectors, stride >> 4, x0, y0,
                       tile * ROOM * STAMPS * STAMPS, &lists, key, slot, &counters->used, capacity))
            continue;  // the host gives more room and asks again
        for (int s = 0; s < STAMPS * STAMPS; s++) {
            const int x = x0 + 4 * (s % STAMPS), y = y0 + 4 * (s / STAMPS);
            if (x >= view->width || y >= view->height) continue;
            begin[(y >> 2) * stamps_across + (x >> 2)] = lists.begin[s];
            layers[(y >> 2) * stamps_across + (x >> 2)] = lists.filled[s];
        }
    }
}

__kernel __attribute__((reqd_work_group_size(1, 1, 1)))
void fill_tiles(__global const View *restrict view, __global const Triangle *restrict triangles,
                __global const int16 *restrict boxes, __global const int16 *restrict coarse,
                __global Counters *restrict counters, const int stride,
                const int capacity,
                __global int *restrict begin,       // (stamps) first layer of each stamp
                __global int *restrict layers,      // (stamps)
                __global float16 *restrict key,     // (capacity) grows with depth, inf = no fragment
                __global int16 *restrict slot)      // (capacity)
{
    fill_all_tiles(get_group_id(0), view, triangles, boxes, coarse, counters, stride, capacity, begin, layers, key,
                   slot);
}
