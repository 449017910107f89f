// A mesh with a view-dependent displacement map: the first front layer of a pixel whose look-up meets material, lit.
// Host: torchmeso/bench/vdm_frame.py; the formula of a look-up: torchmeso/bench/vdm.py

#include "common/address.clh"
#include "common/directions.clh"

#define LEFT 65535
#define FLAT 1e-9f
#define FRONT 1

// What is interpolated over a triangle.
#define U 3
#define FRAME 5  // t, b, n
#define SCALE 14
#define BEND 15  // tt, tb, bb
#define PARTS 18

typedef struct {
    int face, tag;
} Label;

static float3 take(__global const float *p) { return (float3)(p[0], p[1], p[2]); }

// Perspective-correct parts of a triangle where a ray meets it, into lane l, and the way there.
static float meet(__global const float *a, __global const float *b, __global const float *c, const float3 eye,
                  const float3 d, const int l, Floats *at)
{
    const float3 pa = take(a) - eye, pb = take(b) - eye, pc = take(c) - eye, bc = cross(pb, pc);
    const float wa = dot(d, bc), wb = dot(d, cross(pc, pa)), wc = dot(d, cross(pa, pb)), over = 1.0f / (wa + wb + wc);
    for (int i = 3; i < PARTS; i++) at[i].lane[l] = (wa * a[i] + wb * b[i] + wc * c[i]) * over;
    return dot(pa, bc) * over;
}

// See `shade`.
static INNER void shade_stamp(
    const int stamp, __global const int *restrict begin, __global const int *restrict layers,
    __global const float *restrict key, __global const int *restrict slot, __global const Label *restrict labels,
    __global const int *restrict faces, __global const float *restrict vertex, __global const int *restrict table,
    __global const Ring *restrict rings, __global const float *restrict matter, __global const float *restrict view,
    __global const float4 *restrict lighting, const float unit, const float most, const float h, const int n_bend,
    const int n_node, const int n_ring, const int height, const int width, const int voxel_layers,
    const int voxel_rows, const int voxel_columns, const int across, const int down, __global float8 *restrict out)
{
    const int stamps = (across + 3) / 4;
    const int left = stamp % stamps * 4, top = stamp / stamps * 4;
    const float3 light = lighting[0].xyz, power = lighting[1].xyz, eye = take(view + 9);
    const float16 px = left + FX + 0.5f - 0.5f * across, py = top + FY + 0.5f - 0.5f * down;
    const Vector3 w = normalize3((Vector3){px * view[0] - py * view[3] - view[6], px * view[1] - py * view[4] - view[7],
                                           px * view[2] - py * view[5] - view[8]});
    const Floats dx = {w.x}, dy = {w.y}, dz = {w.z};
    float8 found[16];
    for (int l = 0; l < 16; l++) found[l] = 0.0f;
    int open = to_bits((left + LX < across) & (top + LY < down));
    for (int k = begin[stamp]; open && k < begin[stamp] + layers[stamp]; k++) {
        Floats at[PARTS], t;
        for (int i = 0; i < PARTS; i++) at[i].vector = 0.0f;
        t.vector = 0.0f;
        int asked = 0;
        for (int b = open; b; b &= b - 1) {
            const int l = __builtin_ctz(b);
            if (isinf(key[16 * k + l])) {
                open &= ~(1 << l);
                continue;
            }
            const Label label = labels[slot[16 * k + l]];
            if (!(label.tag & FRONT)) continue;
            __global const int *corner = faces + 3 * label.face;
            const float3 d = (float3)(dx.lane[l], dy.lane[l], dz.lane[l]);
            t.lane[l] = meet(vertex + PARTS * corner[0], vertex + PARTS * corner[1], vertex + PARTS * corner[2], eye, d,
                             l, at);
            asked |= 1 << l;
        }
        if (!asked) continue;

        const Vector3 back = {-(w.x * at[5].vector + w.y * at[6].vector + w.z * at[7].vector),
                               -(w.x * at[8].vector + w.y * at[9].vector + w.z * at[10].vector),
                               -(w.x * at[11].vector + w.y * at[12].vector + w.z * at[13].vector)};
        const Vector3 wo = normalize3(back);
        const float16 level = MAX(wo.x * wo.x + wo.y * wo.y, (float16)1e-12f);
        float16 bend = at[BEND].vector * wo.x * wo.x + 2.0f * at[BEND + 1].vector * wo.x * wo.y;
        bend = (bend + at[BEND + 2].vector * wo.y * wo.y) / level;
        bend = MAX(MIN(bend, (float16)most), (float16)-most);

        // The samples around: two curvatures, four directions, four texels.
        const float16 place = (bend / most + 1.0f) * 0.5f * (n_bend - 1);
        const float16 below = MIN(round_down(place), (float16)(n_bend - 2)), upper = place - below;
        const Footprint around = footprint(rings, n_ring, wo);
        const Taps taps = bilinear(at[U].vector, at[U + 1].vector, height, width);
        const int16 first = TO_INT(below) * n_node;
        float16 missing = 0.0f, way = 0.0f;
        for (int n = 0; n < 4; n++)
            for (int i = 0; i < 4; i++) {
                const int16 index = (first + around.node[n].vector) * (height * width) + taps.texel[i].vector;
                const int16 codes = gather_words(table, index, asked);
                const float16 share = around.weight[n].vector * taps.weight[i].vector;
                const int16 near = codes & 0xffff, next = codes >> 16 & 0xffff;
                const float16 of_near = share * (1.0f - upper), of_next = share * upper;
                const float16 near_met = near == LEFT ? (float16)0.0f : of_near;
                const float16 next_met = next == LEFT ? (float16)0.0f : of_next;
                missing += of_near + of_next - near_met - next_met;
                way += near_met * TO_FLOAT(near) + next_met * TO_FLOAT(next);
            }
        const int met = asked & to_bits(missing <= 0.5f);
        if (!met) continue;
        open &= ~met;

        // Arc and height of the way.
        const float16 tau = way * unit / MAX(1.0f - missing, (float16)1e-6f);
        const float16 size = MAX(magnitude(bend), (float16)FLAT), turn = bend * tau;
        const float16 sine = root(MAX(1.0f - wo.z * wo.z, (float16)1e-12f));
        const Floats s = {atan2_(size * tau * sine, 1.0f - turn * wo.z) / size * inverse_root(level)};
        const float16 under = root(MAX(turn * turn - 2.0f * turn * wo.z + 1.0f, (float16)1e-12f));
        float16 z = tau * (turn - 2.0f * wo.z) / (1.0f + under);
        z = MAX(MIN(z, (float16)0.0f), (float16)-h);
        const Floats u = {at[U].vector - s.vector * wo.x}, v = {at[U + 1].vector - s.vector * wo.y}, low = {z};
        const Floats end = {t.vector + at[SCALE].vector * tau};

        for (int b = met; b; b &= b - 1) {
            const int l = __builtin_ctz(b);
            const float own_u = u.lane[l] - floor(u.lane[l]), own_v = 1.0f - (v.lane[l] - floor(v.lane[l]));
            const int column = MIN((int)(own_u * voxel_columns), voxel_columns - 1);
            const int row = MIN((int)(own_v * voxel_rows), voxel_rows - 1);
            const int layer = MIN((int)((low.lane[l] + h) / h * (voxel_layers - 1) + 0.5f), voxel_layers - 1);
            __global const float *own = matter + 10 * ((layer * voxel_rows + row) * voxel_columns + column);
            const int bottom = own[6] == 0.0f;
            const float normal[3] = {bottom ? 0.0f : own[0], bottom ? 0.0f : own[1], bottom ? 1.0f : own[2]};
            const float3 albedo = bottom ? lighting[2].xyz : take(own + 3);
            float cosine = 0.0f;
            for (int i = 0; i < 3; i++)
                cosine += normal[i] * (at[FRAME + 3 * i].lane[l] * light.x + at[FRAME + 3 * i + 1].lane[l] * light.y +
                                       at[FRAME + 3 * i + 2].lane[l] * light.z);
            const float3 rgb = albedo * (power * (MAX(cosine, 0.0f) / PI) + lighting[2].w * 0.5f * (1.0f + normal[2]));
            found[l] = (float8)(end.lane[l], u.lane[l], v.lane[l], low.lane[l], rgb.x, rgb.y, rgb.z, 0.0f);
        }
    }
    for (int l = 0; l < 16; l++)
        if (left + l % 4 < across && top + l / 4 < down) out[(top + l / 4) * across + left + l % 4] = found[l];
}

// One work-item per stamp of 4 x 4 pixels.
__kernel __attribute__((reqd_work_group_size(1, 1, 1)))
void shade(__global const int *restrict begin,      // (stamps) first layer of each
           __global const int *restrict layers,     // (stamps)
           __global const float *restrict key,      // (layers, 16) near to far, inf: no fragment
           __global const int *restrict slot,       // (layers, 16)
           __global const Label *restrict labels,
           __global const int *restrict faces,      // (F, 3)
           __global const float *restrict vertex,   // (V, PARTS)
           __global const int *restrict table,      // (curvature, node, height, width) codes of a way, or
                                                    // LEFT, of a curvature and the next one, << 16
           __global const Ring *restrict rings,
           __global const float *restrict matter,   // (layer, row, column, 10)
           __global const float *restrict view,     // axes times pixel (right, up, back), eye
           __global const float4 *restrict lighting,  // direction, irradiance; bottom's albedo and ambient
           const float unit, const float most, const float h, const int n_bend, const int n_node,
           const int n_ring, const int height, const int width, const int voxel_layers, const int voxel_rows,
           const int voxel_columns, const int across, const int down,
           __global float8 *restrict out)           // (down, across) t, place, rgb
{
    shade_stamp(get_global_id(0), begin, layers, key, slot, labels, faces, vertex, table, rings, matter, view,
                lighting, unit, most, h, n_bend, n_node, n_ring, height, width, voxel_layers, voxel_rows,
                voxel_columns, across, down, out);
}
