// The rasteriser's kernels: vertices, triangles, those that are cut, and tiles.
// Host: torchmeso/render/rasterize.py

#include "render/rasterize.clh"

#pragma OPENCL FP_CONTRACT OFF

// Projects one vertex for one view.
__kernel void project(__global const View *restrict views, __global const double *restrict vertices,  // (V, 3)
                      __global Projected *restrict out, const int count)
{
    const int i = get_global_id(0);
    if (i >= count) return;
    __global const View *view = views + get_global_id(1);
    const double4 p = project_point(view, vertices[3 * i], vertices[3 * i + 1], vertices[3 * i + 2]);
    const double x = p.x / p.z, y = p.y / p.z;
    Projected r;
    r.q = view->perspective ? 1.0 / p.z : p.w;
    const int ahead = p.w >= view->near;
    const int safe = ahead && x <= GUARD_BAND && x >= -GUARD_BAND && y <= GUARD_BAND && y >= -GUARD_BAND;
    r.x = safe ? (int)rint(x * SUBPIXELS) : 0;
    r.y = safe ? (int)rint(y * SUBPIXELS) : 0;
    r.state = (ahead ? AHEAD : 0) | (safe ? SAFE : 0);
    r.pad = 0;
    out[view->vertices + i] = r;
}

// Sets up sixteen faces for one view. `slots` triangles of a view stand together, cut ones behind the others.
__kernel void set_up(__global const View *restrict views, __global const Projected *restrict projected,
                     __global const int *restrict faces,   // (F, 3)
                     __global const int2 *restrict tags,   // (F) component << 2 | CLOSED, object
                     __global Triangle *restrict triangles, __global Slot *restrict slots,
                     __global Label *restrict labels,
                     __global int *restrict boxes,         // (4, slots) per view: low x, low y, -high x, -high y
                     __global int *restrict coarse,        // (4, slots / 16)
                     __global uchar *restrict crossing,    // (padded faces) per view
                     __global Counters *restrict counters,
                     __global const int *restrict objects,  // (view, object) whether it lies beside the view
                     const int count, const int padded, const int stride, const int n_object)
{
    const int v = get_global_id(0);
    if (16 * v >= padded) return;
    __global const View *view = views + get_global_id(1);
    __global const Projected *p = projected + view->vertices;
    __global Counters *counted = counters + get_global_id(1);
    const int coarse_stride = ((stride >> 4) + 15) & ~15;
    __global int *box_of = boxes + 4 * view->slots;
    __global int *coarse_of = coarse + get_global_id(1) * 4 * coarse_stride;
    int around[4] = {LIMIT, LIMIT, LIMIT, LIMIT};
    int behind = 0, cut = 0, drawn = 0, whole = 0, beside = 0, turned = 0;
    for (int lane = 0; lane < 16; lane++) {
        const int f = 16 * v + lane, s = view->slots + f;
        int box[4] = {LIMIT, LIMIT, LIMIT, LIMIT}, crosses = 0;
        if (f < count && objects[get_global_id(1) * n_object + tags[f].y]) {
            beside++;
        } else if (f < count) {
            int x[3], y[3], ahead = 0, safe = 0, front = 0;
            double q[3];
            for (int k = 0; k < 3; k++) {
                const Projected c = p[faces[3 * f + k]];
                x[k] = c.x, y[k] = c.y, q[k] = c.q;
                ahead += c.state & AHEAD;
                safe += c.state & SAFE;
            }
            crosses = ahead > 0 && safe < 3 * SAFE;
            behind += ahead == 0;
            cut += crosses;
            if (safe == 3 * SAFE) {
                const int hidden = view->cull && (tags[f].x & CLOSED);
                whole++;
                double4 planes[3];
                const int made = set_up_triangle(view, x, y, q, hidden, &front, triangles + s, planes, box);
                if (made > 0) {
                    keep_planes(slots + s, labels + s, planes, box);
                    drawn++;
                }
                turned += made < 0;
                labels[s].face = f;
                labels[s].tag = tags[f].x | (front ? FRONT : 0);
                labels[s].object = tags[f].y;
            }
        }
        crossing[get_global_id(1) * padded + f] = crosses;
        for (int k = 0; k < 4; k++) {
            box_of[k * stride + f] = box[k];
            around[k] = MIN(around[k], box[k]);
        }
    }
    for (int k = 0; k < 4; k++) coarse_of[k * coarse_stride + v] = around[k];
    if (drawn) atomic_add(&counted->drawn, drawn);
    if (whole > drawn + turned) atomic_add(&counted->degenerate, whole - drawn - turned);
    if (turned) atomic_add(&counted->turned, turned);
    if (beside) atomic_add(&counted->beside, beside);
    if (cut) atomic_add(&counted->crossing, cut);
    if (behind) atomic_add(&counted->behind, behind);
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
                        __global const int *restrict objects, const int count, const int padded, const int stride,
                        const int n_object)
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
            for (int k = 0; k < 3; k++) {
                __global const double *v = vertices + 3 * faces[3 * f + k];
                const double4 p = project_point(view, v[0], v[1], v[2]);
                corner[k].at[0] = p.x, corner[k].at[1] = p.y, corner[k].at[2] = p.z, corner[k].at[3] = p.w;
                for (int c = 0; c < 3; c++) corner[k].share[c] = c == k;
            }
            int corners = 3;
            for (int plane = 0; plane < 5 && corners; plane++) corners = cut(corner, corners, plane, view->near);
            for (int k = 1; k + 1 < corners; k++, n++) {
                if (padded + n >= stride) continue;  // the host gives more room and asks again
                const int fan[3] = {0, k, k + 1}, s = view->slots + padded + n;
                int x[3], y[3], front = 0, box[4] = {LIMIT, LIMIT, LIMIT, LIMIT};
                double q[3];
                for (int c = 0; c < 3; c++) {
                    const Corner *at = corner + fan[c];
                    x[c] = (int)rint(at->at[0] / at->at[2] * SUBPIXELS);
                    y[c] = (int)rint(at->at[1] / at->at[2] * SUBPIXELS);
                    q[c] = view->perspective ? 1.0 / at->at[2] : at->at[3];
                }
                double4 planes[3];
                // The eye may be inside: nothing is left out.
                if (set_up_triangle(view, x, y, q, 0, &front, triangles + s, planes, box)) {
                    // From the piece's own corners to those of the face.
                    for (int r = 0; r < 3; r++) {
                        const double part[3] = {planes[r].x, planes[r].y, planes[r].z};
                        double whole[3] = {0, 0, 0};
                        for (int c = 0; c < 3; c++)
                            for (int j = 0; j < 3; j++) whole[j] += part[c] * corner[fan[c]].share[j];
                        planes[r] = (double4)(whole[0], whole[1], whole[2], planes[r].w);
                    }
                    keep_planes(slots + s, labels + s, planes, box);
                    counted->drawn++;
                }
                labels[s].face = f;
                labels[s].tag = tags[f].x | (front ? FRONT : 0);
                labels[s].object = tags[f].y;
                for (int b = 0; b < 4; b++) box_of[b * stride + padded + n] = box[b];
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
