// A volume over a mesh as a stack of textured slices, alpha-tested into a depth buffer, lit without shadows.
// Host: torchmeso/bench/slices.py
//
// Corners of all slices are projected, triangles are listed by slice and by bands of eight rows, and each work-item
// draws a band in stamps of 4 x 4 pixels: the bottom slice first, then from the top down.

#define BAND 8  // rows
#define MIN(a, b) ((a) < (b) ? (a) : (b))
#define MAX(a, b) ((a) > (b) ? (a) : (b))

typedef struct {
    float axes[9], eye[3], size, half_width, half_height, near;
} View;

// One work-item per vertex of a slice.
__kernel void project(__global const float *restrict vertices,  // (V, 3)
                      __global const float *restrict shift,     // (V, 3) way from the mesh per tile unit of height
                      __global const View *restrict view, const int n_vertex, const int slices, const float h,
                      __global float4 *restrict corners)        // (slice, V) x, y, 1 / depth; 0: before the near plane
{
    const int i = get_global_id(0), k = i / n_vertex, v = i - k * n_vertex;
    const float z = h * (k / (float)(slices - 1) - 1.0f);
    float p[3];
    for (int c = 0; c < 3; c++) p[c] = vertices[3 * v + c] + z * shift[3 * v + c] - view->eye[c];
    const float x = p[0] * view->axes[0] + p[1] * view->axes[1] + p[2] * view->axes[2];
    const float y = p[0] * view->axes[3] + p[1] * view->axes[4] + p[2] * view->axes[5];
    const float depth = -(p[0] * view->axes[6] + p[1] * view->axes[7] + p[2] * view->axes[8]);
    const float over = depth > view->near ? 1.0f / depth : 0.0f, scale = over / view->size;
    corners[i] = (float4)(view->half_width + x * scale, view->half_height - y * scale, over, 0.0f);
}

// The bands a triangle reaches, first and last; none where first > last.
static int2 bands_of(__global const int *face, __global const float4 *corners, const int width, const int height)
{
    const float4 a = corners[face[0]], b = corners[face[1]], c = corners[face[2]];
    const int2 none = (int2)(1, 0);
    if (!(a.z > 0.0f && b.z > 0.0f && c.z > 0.0f)) return none;
    const float right = MAX(MAX(a.x, b.x), c.x), left = MIN(MIN(a.x, b.x), c.x);
    const float low = MAX(MAX(a.y, b.y), c.y), high = MIN(MIN(a.y, b.y), c.y);
    if (right < 0.0f || left > width || low < 0.0f || high > height) return none;
    const int first = MAX((int)high, 0) / BAND, last = MIN((int)low, height - 1) / BAND;
    return (int2)(first, last);
}

// One work-item per triangle of a slice: counts those of each slice and band.
__kernel void count_triangles(__global const int *restrict faces,       // (F, 3)
                              __global const float4 *restrict corners, const int n_vertex, const int n_face,
                              const int width, const int height, __global int *restrict counts)  // (band, slice)
{
    const int i = get_global_id(0), k = i / n_face, f = i - k * n_face, slices = get_global_size(0) / n_face;
    const int2 bands = bands_of(faces + 3 * f, corners + k * n_vertex, width, height);
    for (int b = bands.x; b <= bands.y; b++) atomic_inc(counts + b * slices + k);
}

// The same: lists them. `next` begins as where each list does.
__kernel void list_triangles(__global const int *restrict faces, __global const float4 *restrict corners,
                             const int n_vertex, const int n_face, const int width, const int height,
                             __global int *restrict next,  // (band, slice)
                             __global int *restrict lists)
{
    const int i = get_global_id(0), k = i / n_face, f = i - k * n_face, slices = get_global_size(0) / n_face;
    const int2 bands = bands_of(faces + 3 * f, corners + k * n_vertex, width, height);
    for (int b = bands.x; b <= bands.y; b++) lists[atomic_inc(next + b * slices + k)] = f;
}

// The share of solid at a place of a layer, bilinear, in codes of 255.
static float solid_at(__global const uchar *layer, const int height, const int width, const float u, const float v)
{
    const float x = (u - floor(u)) * width - 0.5f, y = (1.0f - (v - floor(v))) * height - 0.5f;
    const float left = floor(x), top = floor(y), fx = x - left, fy = y - top;
    int c0 = (int)left, r0 = (int)top;
    c0 = c0 < 0 ? width - 1 : c0;
    r0 = r0 < 0 ? height - 1 : r0;
    const int c1 = c0 + 1 == width ? 0 : c0 + 1, r1 = r0 + 1 == height ? 0 : r0 + 1;
    const float above = layer[r0 * width + c0] * (1.0f - fx) + layer[r0 * width + c1] * fx;
    const float below = layer[r1 * width + c0] * (1.0f - fx) + layer[r1 * width + c1] * fx;
    return above * (1.0f - fy) + below * fy;
}

// One work-item per band; compiled with MOST_ACROSS, the stamps of a row. A pixel is lit by one distant light, by the
// normal and albedo of the nearest voxel and the frame of the triangle's first corner.
__kernel void draw_band(__global const int *restrict faces, __global const float4 *restrict corners,
                        __global const float2 *restrict uv,        // (V)
                        __global const int *restrict begins,       // (band, slice + 1)
                        __global const int *restrict lists,
                        __global const uchar *restrict occupancy,  // (slice, rows, columns)
                        __global const float *restrict matter,     // (slice, rows, columns, 10)
                        __global const float *restrict frames,     // (V, 3, 3) t, b, n
                        const int n_vertex, const int slices, const int rows, const int columns, const int width,
                        const int height, const int floor_below,
                        __global const float4 *restrict lighting,  // direction, irradiance; floor's albedo and ambient
                        __global float *restrict depth,            // (H, W) 1 / depth, 0: nothing
                        __global float4 *restrict rgb)             // (H, W)
{
    const float4 light = lighting[0], power = lighting[1], ground = lighting[2];
    const int band = get_group_id(0), top = band * BAND, across = (width + 3) / 4;
    const float16 lane_x = (float16)(0.5f, 1.5f, 2.5f, 3.5f, 0.5f, 1.5f, 2.5f, 3.5f, 0.5f, 1.5f, 2.5f, 3.5f, 0.5f,
                                     1.5f, 2.5f, 3.5f);
    const float16 lane_y = (float16)(0.5f, 0.5f, 0.5f, 0.5f, 1.5f, 1.5f, 1.5f, 1.5f, 2.5f, 2.5f, 2.5f, 2.5f, 3.5f,
                                     3.5f, 3.5f, 3.5f);
    float16 nearest[2 * MOST_ACROSS];
    int16 slice_of[2 * MOST_ACROSS], face_of[2 * MOST_ACROSS];
    float16 u_of[2 * MOST_ACROSS], v_of[2 * MOST_ACROSS];
    for (int s = 0; s < 2 * across; s++) nearest[s] = 0.0f;
    for (int order = 0; order < slices; order++) {
        const int k = order == 0 ? 0 : slices - order;
        const int opaque = k == 0 && floor_below;
        __global const uchar *layer = occupancy + k * rows * columns;
        for (int j = begins[band * (slices + 1) + k]; j < begins[band * (slices + 1) + k + 1]; j++) {
            const int f = lists[j];
            const int i0 = faces[3 * f], i1 = faces[3 * f + 1], i2 = faces[3 * f + 2];
            const float4 a = corners[k * n_vertex + i0], b = corners[k * n_vertex + i1], c = corners[k * n_vertex + i2];
            const float area = (b.x - a.x) * (c.y - a.y) - (b.y - a.y) * (c.x - a.x);
            if (area == 0.0f) continue;
            const float over = 1.0f / area;
            const float2 ta = uv[i0] * a.z, tb = uv[i1] * b.z, tc = uv[i2] * c.z;
            const int x0 = MAX((int)MIN(MIN(a.x, b.x), c.x), 0) / 4;
            const int x1 = MIN((int)MAX(MAX(a.x, b.x), c.x), width - 1) / 4;
            const int y0 = MAX((int)MIN(MIN(a.y, b.y), c.y), top) / 4;
            const int y1 = MIN((int)MAX(MAX(a.y, b.y), c.y), top + BAND - 1) / 4;
            for (int sy = y0; sy <= y1; sy++)
                for (int sx = x0; sx <= x1; sx++) {
                    const float16 x = 4.0f * sx + lane_x, y = 4.0f * sy + lane_y;
                    const float16 w0 = ((b.x - x) * (c.y - y) - (b.y - y) * (c.x - x)) * over;
                    const float16 w1 = ((c.x - x) * (a.y - y) - (c.y - y) * (a.x - x)) * over;
                    const float16 w2 = 1.0f - w0 - w1;
                    const float16 z = w0 * a.z + w1 * b.z + w2 * c.z;
                    const int s = (sy & 1) * across + sx;
                    int16 in = (w0 >= 0.0f) & (w1 >= 0.0f) & (w2 >= 0.0f) & (z > nearest[s]);
                    union { int16 vector; int lane[16]; } mask = {in};
                    int some = 0;
                    for (int l = 0; l < 16; l++) some |= (mask.lane[l] & 1) << l;
                    if (!some) continue;
                    const float16 back = 1.0f / z;
                    union { float16 vector; float lane[16]; } u = {(w0 * ta.x + w1 * tb.x + w2 * tc.x) * back};
                    union { float16 vector; float lane[16]; } v = {(w0 * ta.y + w1 * tb.y + w2 * tc.y) * back};
                    if (!opaque) {
                        for (int l = 0; l < 16; l++)
                            if (some >> l & 1)
                                mask.lane[l] = -(solid_at(layer, rows, columns, u.lane[l], v.lane[l]) > 127.5f);
                        in = mask.vector;
                    }
                    nearest[s] = in ? z : nearest[s];
                    slice_of[s] = in ? (int16)k : slice_of[s];
                    face_of[s] = in ? (int16)f : face_of[s];
                    u_of[s] = in ? u.vector : u_of[s];
                    v_of[s] = in ? v.vector : v_of[s];
                }
        }
    }
    for (int y = top; y < MIN(top + BAND, height); y++)
        for (int x = 0; x < width; x++) {
            const int s = (y / 4 & 1) * across + x / 4, l = (y & 3) * 4 + (x & 3), at = y * width + x;
            const float z = ((const float *)(nearest + s))[l];
            depth[at] = z;
            rgb[at] = 0.0f;
            if (!(z > 0.0f)) continue;
            const int k = ((const int *)(slice_of + s))[l], vertex = faces[3 * ((const int *)(face_of + s))[l]];
            const float u = ((const float *)(u_of + s))[l], v = ((const float *)(v_of + s))[l];
            const int column = MIN((int)((u - floor(u)) * columns), columns - 1);
            const int row = MIN((int)((1.0f - (v - floor(v))) * rows), rows - 1);
            __global const float *voxel = matter + 10 * ((k * rows + row) * columns + column);
            const float plain[6] = {0.0f, 0.0f, 1.0f, ground.x, ground.y, ground.z};
            float own[6];
            for (int c = 0; c < 6; c++) own[c] = k == 0 && floor_below ? plain[c] : voxel[c];
            float cosine = 0.0f;
            for (int c = 0; c < 3; c++) {
                __global const float *axis = frames + 9 * vertex + 3 * c;
                cosine += own[c] * (axis[0] * light.x + axis[1] * light.y + axis[2] * light.z);
            }
            const float4 albedo = (float4)(own[3], own[4], own[5], 0.0f);
            const float4 arriving = power * (MAX(cosine, 0.0f) / 3.14159265f);
            rgb[at] = albedo * (arriving + ground.w * 0.5f * (1.0f + own[2]));
        }
}
