// A mesh with a view-dependent displacement map: the first front layer of a pixel whose look-up meets material, lit.
// Host: torchmeso/bench/vdm_frame.py; the formula of a look-up: torchmeso/bench/vdm.py

#define LEFT 65535
#define PI 3.14159265f
#define FLAT 1e-9f
#define MIN(a, b) ((a) < (b) ? (a) : (b))
#define MAX(a, b) ((a) > (b) ? (a) : (b))
#define PARTS 18  // of a vertex: position, u v, t, b, n, scale, curvature
#define FRONT 1

typedef struct {
    int face, tag;
} Label;

static float3 take(__global const float *p) { return (float3)(p[0], p[1], p[2]); }

// One work-item per stamp of 4 x 4 pixels.
__kernel void shade(__global const int *restrict begin,      // (stamps) first layer of each
                    __global const int *restrict layers,     // (stamps)
                    __global const float *restrict key,      // (layers, 16) near to far, inf: no fragment
                    __global const int *restrict slot,       // (layers, 16)
                    __global const Label *restrict labels,
                    __global const int *restrict faces,      // (F, 3)
                    __global const float *restrict vertex,   // (V, PARTS)
                    __global const ushort *restrict table,   // (curvature, node, height, width) code of a way, or LEFT
                    __global const float4 *restrict rings,   // theta, size, first azimuth, first node
                    __global const float *restrict matter,   // (layer, row, column, 10)
                    __global const float *restrict view,     // axes times pixel (right, up, back), eye
                    __global const float4 *restrict lighting,  // direction, irradiance; bottom's albedo and ambient
                    const float unit, const float most, const float h, const int n_bend, const int n_node,
                    const int n_ring, const int height, const int width, const int voxel_layers, const int voxel_rows,
                    const int voxel_columns, const int across, const int down,
                    __global float8 *restrict out)           // (down, across) t, place, rgb
{
    const int stamp = get_global_id(0), stamps = (across + 3) / 4;
    const int left = stamp % stamps * 4, top = stamp / stamps * 4;
    const float3 light = lighting[0].xyz, power = lighting[1].xyz, eye = take(view + 9);
    for (int lane = 0; lane < 16; lane++) {
        const int px = left + lane % 4, py = top + lane / 4;
        if (px >= across || py >= down) continue;
        float8 found = 0.0f;
        const float3 d = normalize(take(view) * (px + 0.5f - 0.5f * across) - take(view + 3) * (py + 0.5f - 0.5f * down) -
                                   take(view + 6));
        for (int k = begin[stamp]; k < begin[stamp] + layers[stamp]; k++) {
            if (isinf(key[16 * k + lane])) break;
            const Label label = labels[slot[16 * k + lane]];
            if (!(label.tag & FRONT)) continue;
            __global const float *a = vertex + PARTS * faces[3 * label.face];
            __global const float *b = vertex + PARTS * faces[3 * label.face + 1];
            __global const float *c = vertex + PARTS * faces[3 * label.face + 2];
            const float3 pa = take(a) - eye, pb = take(b) - eye, pc = take(c) - eye;
            const float3 bc = cross(pb, pc), ca = cross(pc, pa), ab = cross(pa, pb);
            float wa = dot(d, bc), wb = dot(d, ca), wc = dot(d, ab);
            const float sum = 1.0f / (wa + wb + wc);
            wa *= sum;
            wb *= sum;
            wc *= sum;
            float at[PARTS];
            for (int i = 0; i < PARTS; i++) at[i] = wa * a[i] + wb * b[i] + wc * c[i];
            float3 wo = -(float3)(dot(d, (float3)(at[5], at[6], at[7])), dot(d, (float3)(at[8], at[9], at[10])),
                                  dot(d, (float3)(at[11], at[12], at[13])));
            wo = normalize(wo);
            const float level = MAX(wo.x * wo.x + wo.y * wo.y, 1e-12f);
            float bend = (at[15] * wo.x * wo.x + 2.0f * at[16] * wo.x * wo.y + at[17] * wo.y * wo.y) / level;
            bend = MAX(MIN(bend, most), -most);

            // The samples around: two curvatures, four directions, four texels.
            const float place = (bend / most + 1.0f) * 0.5f * (n_bend - 1);
            const int below = MIN((int)place, n_bend - 2);
            const float upper = place - below;
            float theta = acos(MAX(MIN(wo.z, 1.0f), -1.0f)), phi = atan2(wo.y, wo.x);
            theta = MIN(theta, rings[n_ring - 1].x);
            int ring = 0;
            while (ring + 2 < n_ring && rings[ring + 1].x <= theta) ring++;
            const float outer = MIN((theta - rings[ring].x) / (rings[ring + 1].x - rings[ring].x), 1.0f);
            const float u = at[3] - floor(at[3]), v = at[4] - floor(at[4]);
            const float x = u * width - 0.5f, y = (1.0f - v) * height - 0.5f;
            const float fx = x - floor(x), fy = y - floor(y);
            const int c0 = ((int)floor(x) + width) % width, r0 = ((int)floor(y) + height) % height;
            const int c1 = c0 + 1 == width ? 0 : c0 + 1, r1 = r0 + 1 == height ? 0 : r0 + 1;
            const int texel[4] = {r0 * width + c0, r0 * width + c1, r1 * width + c0, r1 * width + c1};
            const float weight[4] = {(1.0f - fx) * (1.0f - fy), fx * (1.0f - fy), (1.0f - fx) * fy, fx * fy};
            float missing = 0.0f, way = 0.0f;
            for (int r = 0; r < 2; r++) {
                const float4 of = rings[ring + r];
                const float turn = (phi - of.z) * of.y * (0.5f / PI), first = floor(turn), part = turn - first;
                const int size = (int)of.y;
                for (int j = 0; j < 2; j++) {
                    const int node = (int)of.w + (((int)first + j) % size + size) % size;
                    const float of_node = (r ? outer : 1.0f - outer) * (j ? part : 1.0f - part);
                    for (int bended = 0; bended < 2; bended++) {
                        __global const ushort *samples = table + ((below + bended) * n_node + node) * height * width;
                        const float of_both = of_node * (bended ? upper : 1.0f - upper);
                        for (int i = 0; i < 4; i++) {
                            const ushort code = samples[texel[i]];
                            missing += code == LEFT ? of_both * weight[i] : 0.0f;
                            way += code == LEFT ? 0.0f : of_both * weight[i] * code;
                        }
                    }
                }
            }
            if (missing > 0.5f) continue;
            const float tau = way * unit / MAX(1.0f - missing, 1e-6f);
            bend = fabs(bend) < FLAT ? FLAT : bend;
            const float sine = sqrt(MAX(1.0f - wo.z * wo.z, 0.0f)), round = bend * tau;
            const float s = atan2(fabs(round) * sine, 1.0f - round * wo.z) / fabs(bend);
            float z = tau * (round - 2.0f * wo.z) /
                      (1.0f + sqrt(MAX(round * round - 2.0f * round * wo.z + 1.0f, 0.0f)));
            z = MAX(MIN(z, 0.0f), -h);
            const float hit_u = at[3] - s * wo.x * rsqrt(level), hit_v = at[4] - s * wo.y * rsqrt(level);
            const float t = dot(pa, cross(pb - pa, pc - pa)) / dot(d, cross(pb - pa, pc - pa));
            const int column = MIN((int)((hit_u - floor(hit_u)) * voxel_columns), voxel_columns - 1);
            const int row = MIN((int)((1.0f - (hit_v - floor(hit_v))) * voxel_rows), voxel_rows - 1);
            const int layer = MIN((int)((z + h) / h * (voxel_layers - 1) + 0.5f), voxel_layers - 1);
            __global const float *own = matter + 10 * ((layer * voxel_rows + row) * voxel_columns + column);
            const int bottom = own[6] == 0.0f;
            const float3 normal = bottom ? (float3)(0.0f, 0.0f, 1.0f) : take(own);
            const float3 albedo = bottom ? lighting[2].xyz : take(own + 3);
            const float cosine = normal.x * dot(light, (float3)(at[5], at[6], at[7])) +
                                 normal.y * dot(light, (float3)(at[8], at[9], at[10])) +
                                 normal.z * dot(light, (float3)(at[11], at[12], at[13]));
            const float3 rgb = albedo * (power * (MAX(cosine, 0.0f) / PI) + lighting[2].w * 0.5f * (1.0f + normal.z));
            found = (float8)(t + at[14] * tau, hit_u, hit_v, z, rgb.x, rgb.y, rgb.z, 0.0f);
            break;
        }
        out[py * across + px] = found;
    }
}
