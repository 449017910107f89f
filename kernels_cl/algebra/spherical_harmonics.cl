// The basis of spherical harmonics for many directions: sixteen of them in a vector, four vectors per work-item.
// Host: torchmeso/algebra/spherical_harmonics.py

#include "algebra/spherical_harmonics.clh"

#define GROUPS 4

INNER static void basis_of_sixteen(__global const float *steps, const int degree, __global const float *directions,
                                   const int count, __global float *out)
{
    const int n = (degree + 1) * (degree + 1);
    Floats x, y, z, values[(MOST_DEGREE + 1) * (MOST_DEGREE + 1)];
    for (int l = 0; l < 16; l++) {
        __global const float *w = directions + 3 * min(l, count - 1);
        x.lane[l] = w[0], y.lane[l] = w[1], z.lane[l] = w[2];
    }
    const Vector3 w = {x.vector, y.vector, z.vector};
    harmonics(steps, degree, w, &values[0].vector);
    for (int l = 0; l < count; l++)
        for (int i = 0; i < n; i++) out[l * n + i] = values[i].lane[l];
}

// directions (count, 3), out (count, n).
__kernel void basis(__global const float *steps, const int degree, __global const float *directions, const int count,
                    __global float *out)
{
    for (int group = 0; group < GROUPS; group++) {
        const int first = 16 * (GROUPS * get_global_id(0) + group);
        if (first >= count) return;
        basis_of_sixteen(steps, degree, directions + 3 * first, min(16, count - first),
                         out + (size_t)first * (degree + 1) * (degree + 1));
    }
}

INNER static void rotate_sixteen(__global const float *J, const int degree, __global const float *rotations,
                                 const int each, __global const float *in, const int count, __global float *out)
{
    const int n = (degree + 1) * (degree + 1);
    Floats R[9], c[(MOST_DEGREE + 1) * (MOST_DEGREE + 1)], d[(MOST_DEGREE + 1) * (MOST_DEGREE + 1)];
    for (int l = 0; l < 16; l++) {
        const int from = min(l, count - 1);
        for (int k = 0; k < 9; k++) R[k].lane[l] = rotations[9 * from * each + k];
        for (int i = 0; i < n; i++) c[i].lane[l] = in[n * from + i];
    }
    const Rotation rotation = {{R[0].vector, R[1].vector, R[2].vector}, {R[3].vector, R[4].vector, R[5].vector},
                               {R[6].vector, R[7].vector, R[8].vector}};
    rotate_harmonics(J, degree, &rotation, &c[0].vector, &d[0].vector);
    for (int l = 0; l < count; l++)
        for (int i = 0; i < n; i++) out[l * n + i] = c[i].lane[l];
}

// in, out (count, n); rotations (count, 3, 3), or one of them for all (each = 0).
__kernel void rotate_vectors(__global const float *J, const int degree, __global const float *rotations, const int each,
                     __global const float *in, const int count, __global float *out)
{
    const size_t n = (degree + 1) * (degree + 1);
    for (int group = 0; group < GROUPS; group++) {
        const int first = 16 * (GROUPS * get_global_id(0) + group);
        if (first >= count) return;
        rotate_sixteen(J, degree, rotations + 9 * first * each, each, in + n * first, min(16, count - first),
                       out + n * first);
    }
}
