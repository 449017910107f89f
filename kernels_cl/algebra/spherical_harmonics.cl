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

typedef struct {
    float16 cosine, sine;
} Turn;

// The turn that a vector in the plane points to; none where it is 0.
static Turn turn_to(const float16 x, const float16 y)
{
    const float16 square = x * x + y * y, per_length = inverse_root(square);
    const int16 some = square > 1e-30f;
    const Turn t = {some ? x * per_length : (float16)1.0f, some ? y * per_length : (float16)0.0f};
    return t;
}

// Each pair (m, -m) turns by m times the angle.
static void turn_about_z(const int degree, const Turn turn, float16 *c)
{
    float16 cosine = 1.0f, sine = 0.0f;
    for (int m = 1; m <= degree; m++) {
        const float16 x = turn.cosine * cosine - turn.sine * sine;
        sine = turn.sine * cosine + turn.cosine * sine;
        cosine = x;
        for (int l = m; l <= degree; l++) {
            float16 *plus = c + l * l + l + m, *minus = c + l * l + l - m;
            const float16 a = *plus, b = *minus;
            *plus = a * cosine - b * sine;
            *minus = b * cosine + a * sine;
        }
    }
}

// out = J in, or J^T in. `J` holds one block for each l.
static void quarter_turn(__global const float *J, const int degree, const int transposed, const float16 *in,
                         float16 *out)
{
    for (int l = 0; l <= degree; l++) {
        const int size = 2 * l + 1, step = transposed ? size : 1, row = transposed ? 1 : size;
        for (int i = 0; i < size; i++) {
            float16 sum = 0.0f;
            for (int j = 0; j < size; j++) sum += J[i * row + j * step] * in[l * l + j];
            out[l * l + i] = sum;
        }
        J += size * size;
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
    // R = Rz(alpha) Ry(beta) Rz(gamma); beta and gamma from Rz(-alpha) R, as the host does.
    const Turn alpha = turn_to(R[2].vector, R[5].vector);
    const Turn beta = turn_to(R[8].vector, alpha.cosine * R[2].vector + alpha.sine * R[5].vector);
    const Turn gamma = turn_to(alpha.cosine * R[4].vector - alpha.sine * R[1].vector,
                               alpha.cosine * R[3].vector - alpha.sine * R[0].vector);
    turn_about_z(degree, gamma, &c[0].vector);
    quarter_turn(J, degree, 0, &c[0].vector, &d[0].vector);
    turn_about_z(degree, beta, &d[0].vector);
    quarter_turn(J, degree, 1, &d[0].vector, &c[0].vector);
    turn_about_z(degree, alpha, &c[0].vector);
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
