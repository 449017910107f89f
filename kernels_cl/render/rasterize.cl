// All-layer rasteriser: every fragment of every triangle, near to far.
// Host: torchmeso/render/rasterize.py
//
// One work-item per tile of 64 x 64 pixels, stamps of 4 x 4 pixels in one vector. Edge functions are exact: at
// pixel centres E = n + 256 (A x + B y), so E >= 0 exactly when (n >> 8) + A x + B y >= 0, and inside a tile the
// last sum fits 32 bits (A, B < 2^23, x, y < 64) once the value at its corner is clamped to +-2^30.
//
// The tile is walked twice: first fragments are counted, then as many layers as the deepest pixel of each stamp needs
// are taken from one counter, and fragments are inserted in order of depth, 16 pixels at once. Stamps lie anywhere in
// memory; their content does not depend on the order of tiles.

#define TILE 64
#define STAMPS (TILE / 4)
#define LIMIT (1 << 30)

#if __has_builtin(__builtin_reduce_or)
#define ANY(m) (__builtin_reduce_or(m) != 0)
#else
#define ANY(m) any_lane(m)
static int any_lane(const int16 m)
{
    const int8 a = m.lo | m.hi;
    const int4 b = a.lo | a.hi;
    const int2 c = b.lo | b.hi;
    return (c.x | c.y) != 0;
}
#endif

// The lanes of a vector one by one, without a call.
typedef union {
    int16 vector;
    int lane[16];
} Lanes;

#define LX ((int16)(0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3))
#define FX ((float16)(0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3))
#define FY ((float16)(0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3))
#define LY ((int16)(0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3))

typedef struct {
    int a[3], b[3];      // edge functions per pixel along x and y
    int low_x, low_y;    // pixels whose centres lie in the bounding box, inclusive
    int high_x, high_y;
    int perspective, pad;
    long n[3];           // edge functions at pixel (0, 0), minus one where the edge is not top-left
    double q[3];         // what is linear on the screen at pixel (0, 0), and per pixel along x and y
    float q_low, q_high; // range of the corners
} Triangle;

// Sets up one triangle from snapped corners (1/256 pixel).
__kernel void set_up(__global const double *restrict xy,    // (T, 3, 2)
                   __global const double *restrict q,     // (T, 3)
                   __global const uchar *restrict front,  // (T)
                   __global const double *restrict area,  // (T)
                   __global Triangle *restrict out,       // (T)
                   __global int *restrict boxes,          // (4, padded): low x, low y, -high x, -high y
                   int count, int padded, int width, int height, int perspective)
{
    const int i = get_global_id(0);
    if (i >= padded) return;
    if (i >= count) {  // fills the last vector of boxes: touches no tile
        for (int k = 0; k < 4; k++) boxes[k * padded + i] = LIMIT;
        return;
    }
    Triangle t;
    const double turn = front[i] ? -1.0 : 1.0;
    double x[3], y[3], low_x = 1e30, low_y = 1e30, high_x = -1e30, high_y = -1e30;
    float q_low = INFINITY, q_high = -INFINITY;
    t.q[0] = t.q[1] = t.q[2] = 0;
    for (int k = 0; k < 3; k++) {
        x[k] = xy[6 * i + 2 * k];
        y[k] = xy[6 * i + 2 * k + 1];
        low_x = x[k] < low_x ? x[k] : low_x, high_x = x[k] > high_x ? x[k] : high_x;
        low_y = y[k] < low_y ? y[k] : low_y, high_y = y[k] > high_y ? y[k] : high_y;
        const float value = (float)q[3 * i + k];
        q_low = value < q_low ? value : q_low, q_high = value > q_high ? value : q_high;
    }
    for (int k = 0; k < 3; k++) {
        const int b = (k + 1) % 3, c = (k + 2) % 3;
        const double A = (y[b] - y[c]) * turn, B = (x[c] - x[b]) * turn;
        const double centre = -(A * x[b] + B * y[b]) + 128 * (A + B);
        const int top_left = A > 0 || (A == 0 && B > 0);
        t.a[k] = (int)A;
        t.b[k] = (int)B;
        t.n[k] = (long)centre - !top_left;
        const double share = q[3 * i + k] / area[i];
        t.q[0] += centre * share;
        t.q[1] += 256 * A * share;
        t.q[2] += 256 * B * share;
    }
    t.q_low = q_low;
    t.q_high = q_high;
    t.perspective = perspective;
    t.pad = 0;
    const double first_x = ceil((low_x - 128) / 256), first_y = ceil((low_y - 128) / 256);
    const double last_x = floor((high_x - 128) / 256), last_y = floor((high_y - 128) / 256);
    t.low_x = first_x > 0 ? (int)first_x : 0;
    t.low_y = first_y > 0 ? (int)first_y : 0;
    t.high_x = last_x < width - 1 ? (int)last_x : width - 1;
    t.high_y = last_y < height - 1 ? (int)last_y : height - 1;
    const int empty = t.low_x > t.high_x || t.low_y > t.high_y;
    boxes[i] = empty ? LIMIT : t.low_x;
    boxes[padded + i] = empty ? LIMIT : t.low_y;
    boxes[2 * padded + i] = empty ? LIMIT : -t.high_x;
    boxes[3 * padded + i] = empty ? LIMIT : -t.high_y;
    out[i] = t;
}

static int corner_value(__global const Triangle *t, int k, int x, int y)
{
    const long value = (t->n[k] >> 8) + (long)t->a[k] * x + (long)t->b[k] * y;
    return value > LIMIT ? LIMIT : value < -LIMIT ? -LIMIT : (int)value;
}

// All fragments of a picture.
__kernel __attribute__((reqd_work_group_size(1, 1, 1)))
void fill_tiles(__global const Triangle *restrict triangles,  // (T)
                __global const int16 *restrict boxes,         // (4, padded / 16)
                int vectors,                                  // padded / 16
                int width, int height, float pixel_size,
                __global int *restrict used,                  // (1) layers so far, also those that found no room
                int capacity,
                __global int *restrict begin,                 // (stamps) first layer of each stamp
                __global int *restrict layers,                // (stamps)
                __global float16 *restrict depth,             // (capacity) t, inf = no fragment
                __global int16 *restrict triangle)            // (capacity)
{
    const int x0 = get_group_id(0) * TILE, y0 = get_group_id(1) * TILE;
    const int x1 = x0 + TILE <= width ? x0 + TILE - 1 : width - 1;
    const int y1 = y0 + TILE <= height ? y0 + TILE - 1 : height - 1;
    const int across = (width + 3) >> 2;
    int16 counts[STAMPS * STAMPS];
    int first[STAMPS * STAMPS], filled[STAMPS * STAMPS];
    for (int s = 0; s < STAMPS * STAMPS; s++) counts[s] = 0;

    for (int pass = 0; pass < 2; pass++) {
        for (int v = 0; v < vectors; v++) {
            const int16 hit = (boxes[v] <= x1) & (boxes[vectors + v] <= y1) & (boxes[2 * vectors + v] <= -x0) &
                              (boxes[3 * vectors + v] <= -y0);
            if (!ANY(hit)) continue;
            const Lanes hits = {hit};
            for (int lane = 0; lane < 16; lane++) {
                if (!hits.lane[lane]) continue;
                const int id = 16 * v + lane;
                __global const Triangle *t = triangles + id;
                const int a0 = t->a[0], a1 = t->a[1], a2 = t->a[2], b0 = t->b[0], b1 = t->b[1], b2 = t->b[2];
                const int16 e0 = a0 * LX + b0 * LY + corner_value(t, 0, x0, y0);
                const int16 e1 = a1 * LX + b1 * LY + corner_value(t, 1, x0, y0);
                const int16 e2 = a2 * LX + b2 * LY + corner_value(t, 2, x0, y0);
                const float qx = (float)t->q[1], qy = (float)t->q[2], q_low = t->q_low, q_high = t->q_high;
                const float16 q_in_stamp = qx * FX + qy * FY;
                const int left = t->low_x > x0 ? (t->low_x - x0) >> 2 : 0;
                const int top = t->low_y > y0 ? (t->low_y - y0) >> 2 : 0;
                const int right = ((t->high_x < x1 ? t->high_x : x1) - x0) >> 2;
                const int bottom = ((t->high_y < y1 ? t->high_y : y1) - y0) >> 2;
                for (int sy = top; sy <= bottom; sy++) {
                    for (int sx = left; sx <= right; sx++) {
                        const int dx = 4 * sx, dy = 4 * sy, stamp = sy * STAMPS + sx;
                        const int16 outside = (e0 + (a0 * dx + b0 * dy)) | (e1 + (a1 * dx + b1 * dy)) |
                                              (e2 + (a2 * dx + b2 * dy)) | (x1 - x0 - dx - LX) | (y1 - y0 - dy - LY);
                        const int16 inside = ~(outside >> 31);
                        if (!ANY(inside)) continue;
                        if (pass == 0) {
                            counts[stamp] -= inside;
                            continue;
                        }
                        // In double to the stamp's corner: a needle's slope is far larger than its range.
                        float16 z = (float)(t->q[0] + t->q[1] * (x0 + dx) + t->q[2] * (y0 + dy)) + q_in_stamp;
                        z = z < q_low ? q_low : z;
                        z = z > q_high ? q_high : z;
                        if (t->perspective) {
                            const float16 u = (FX + (x0 + dx + 0.5f - 0.5f * width)) * pixel_size;
                            const float16 w = (FY + (y0 + dy + 0.5f - 0.5f * height)) * pixel_size;
                            const float16 square = 1.0f + u * u + w * w;
                            // 1 / sqrt by three Newton steps: the built-in has no 16-wide form on every device.
                            float16 r = as_float16(0x5f375a86 - (as_int16(square) >> 1));
                            r *= 1.5f - 0.5f * square * r * r;
                            r *= 1.5f - 0.5f * square * r * r;
                            r *= 1.5f - 0.5f * square * r * r;
                            z = square * r / z;
                        }
                        z = inside ? z : (float16)INFINITY;
                        // Insertion: the first layer behind the new one and all after it move on by one, so that equal
                        // depths stay in the order of triangles.
                        int16 ids = id, moves = 0;
                        __global float16 *d = depth + first[stamp];
                        __global int16 *o = triangle + first[stamp];
                        int k = 0;
                        for (; k < filled[stamp]; k++) {
                            const float16 z_k = d[k];
                            const int16 id_k = o[k];
                            moves |= z < z_k;
                            d[k] = moves ? z : z_k;
                            o[k] = moves ? ids : id_k;
                            z = moves ? z_k : z;
                            ids = moves ? id_k : ids;
                        }
                        if (ANY(z < INFINITY)) {
                            d[k] = z;
                            o[k] = ids;
                            filled[stamp] = k + 1;
                        }
                    }
                }
            }
        }
        if (pass == 1) return;
        int total = 0;
        for (int s = 0; s < STAMPS * STAMPS; s++) {
            const Lanes n = {counts[s]};
            int deepest = 0;
            for (int l = 0; l < 16; l++) deepest = n.lane[l] > deepest ? n.lane[l] : deepest;
            first[s] = total;
            filled[s] = deepest;
            total += deepest;
        }
        const int room = total ? atomic_add(used, total) : 0;
        for (int s = 0; s < STAMPS * STAMPS; s++) {
            const int x = (x0 >> 2) + s % STAMPS, y = (y0 >> 2) + s / STAMPS;
            first[s] += room;
            if (4 * x <= x1 && 4 * y <= y1) {
                begin[y * across + x] = first[s];
                layers[y * across + x] = filled[s];
            }
            filled[s] = 0;
        }
        if (!total || room + total > capacity) return;  // the host gives more room and asks again
    }
}
