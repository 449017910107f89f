// A list of rays through a shell.
// Host: torchmeso/render/device_trace.py

#include "render/gdm_trace.clh"

// A ray, and what it met.
typedef struct {
    float origin[3], direction[3];
    int entry, pad;  // 4 tet + corner opposite the face it comes in by
} Ray;
typedef struct {
    float t, place[3], way[3];
    int prism, hit, through, prisms, pad[5];  // through: THROUGH_*, 0 where there is material; prisms: -1 is lost
} Answer;

static INNER void trace_sixteen(__global const Ray *rays, const Shells *shells, __global const uchar *tables,
                                __global const Gdm *gdm, const int count, __global Answer *answers,
                                __global int *counted)
{
    Floats p[6];
    Ints entry;
    for (int c = 0; c < 6; c++) p[c].vector = c == 5 ? 1.0f : 0.0f;
    entry.vector = 0;
    for (int l = 0; l < count; l++) {
        for (int c = 0; c < 3; c++) {
            p[c].lane[l] = rays[l].origin[c];
            p[3 + c].lane[l] = rays[l].direction[c];
        }
        entry.lane[l] = rays[l].entry;
    }
    const Vector3 origin = {p[0].vector, p[1].vector, p[2].vector};
    const Vector3 along = {p[3].vector, p[4].vector, p[5].vector};
    Met met;
    const int bits = (1 << count) - 1;
    const int hit = walk(shells, tables, gdm, &origin, &along, 0.0f, bits, entry.vector, 0, &met);
    const Floats u = {met.place.u}, v = {met.place.v}, z = {met.place.z};
    const Floats wx = {met.way.x}, wy = {met.way.y}, wz = {met.way.z};
    for (int l = 0; l < count; l++) {
        __global Answer *a = answers + l;
        a->t = met.t.lane[l];
        a->place[0] = u.lane[l], a->place[1] = v.lane[l], a->place[2] = z.lane[l];
        a->way[0] = wx.lane[l], a->way[1] = wy.lane[l], a->way[2] = wz.lane[l];
        a->prism = met.prism.lane[l];
        a->hit = hit >> l & 1;
        a->through = met.through.lane[l];
        a->prisms = met.endless >> l & 1 ? -1 : met.passed.lane[l];
    }
    atomic_add(counted, met.prisms);
    atomic_add(counted + 1, met.steps);
    atomic_add(counted + 2, met.carried);
}

__kernel __attribute__((reqd_work_group_size(1, 1, 1)))
void trace(__global const Ray *restrict rays, __global const float4 *restrict tets,
           __global const float4 *restrict vertices, __global const Prism *restrict prisms,
           __global const uchar *restrict tables, __global const Gdm *restrict gdm, const int n_ray,
           __global Answer *restrict answers, __global int *restrict counted)
{
    const Shells shells = {tets, vertices, prisms};
    const int at = 16 * get_group_id(0);
    trace_sixteen(rays + at, &shells, tables, gdm, MIN(n_ray - at, 16), answers + at, counted);
}
