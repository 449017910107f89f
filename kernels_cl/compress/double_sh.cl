// Constrained least squares of many columns of samples: sixteen columns at a time, one per lane.
//
// Host: torchmeso/compress/double_sh.py, formula: torchmeso/algebra/secular.py. The numbers of samples and terms are
// constants of the build (SAMPLES, TERMS), so that sums stay in registers; BLOCK terms are summed at once, as many as
// a core has registers for. Columns may be bytes (CODES), of linear values or codes in sRGB (SRGB).

#include "common/vector.clh"

#define GROUPS 4  // of sixteen columns per work-item: the line of the cache that bytes lie in

typedef float16 AnyWhere16 __attribute__((aligned(4)));
typedef uchar16 AnyByte16 __attribute__((aligned(1)));

// What a set of directions brings along; the host writes it as one array.
typedef struct {
    float left[SAMPLES][TERMS];
    float solid_angle[SAMPLES];  // times the dial of the energy
    float value[TERMS];
    float square[TERMS];  // of `value`; 1 where the samples cannot tell
    float right[TERMS][TERMS];
} Factors;

#ifdef CODES
typedef uchar Sample;
#define BYTES(p) __builtin_convertvector(*(__global const AnyByte16 *)(p), float16)
#ifdef SRGB
// Linear values of sRGB codes: ((x + 0.055) / 1.055)^2.4 as a polynomial in 2 x - 1, the best one for the codes from
// 11 on; off by 4e-7 at most. A table would be read a lane at a time.
static float16 from_srgb(const float16 code)
{
    const float16 t = code * (2.0f / 255.0f) - 1.0f;
    float16 p = 0.0002575437f;
    p = p * t - 0.00014576169f;
    p = p * t - 0.0004032299f;
    p = p * t - 4.0076473e-05f;
    p = p * t + 0.0006342977f;
    p = p * t - 0.0005417705f;
    p = p * t + 0.0012253036f;
    p = p * t - 0.004748245f;
    p = p * t + 0.035077337f;
    p = p * t + 0.29185295f;
    p = p * t + 0.4627909f;
    p = p * t + 0.21404108f;
    return code < 10.5f ? code * (1.0f / (255.0f * 12.92f)) : p;
}
#define READ(p) from_srgb(BYTES(p))
#else
#define READ(p) (unit * BYTES(p))
#endif
#else
typedef float Sample;
#define READ(p) (unit * *(__global const AnyWhere16 *)(p))
#endif

// Terms FIRST .. LAST - 1 of U^T beta, and the energy.
#define SUM(FIRST, LAST)                                                              \
    {                                                                                 \
        float16 g[BLOCK];                                                             \
        _Pragma("unroll") for (int k = 0; k < BLOCK; k++) g[k] = 0.0f;                \
        float16 square = 0.0f;                                                        \
        for (int j = 0; j < SAMPLES; j++) {                                           \
            const float16 f = READ(samples + j * stride);                             \
            _Pragma("unroll") for (int k = 0; k < BLOCK; k++)                         \
                if ((FIRST) + k < TERMS) g[k] += factors->left[j][(FIRST) + k] * f;   \
            if ((FIRST) == 0) square += factors->solid_angle[j] * f * f;              \
        }                                                                             \
        _Pragma("unroll") for (int k = 0; k < BLOCK; k++)                             \
            if ((FIRST) + k < TERMS) w[(FIRST) + k] = g[k] * factors->value[(FIRST) + k]; \
        if ((FIRST) == 0) energy = square;                                            \
    }

// The least multiplier that leaves the energy under its bound, by Newton's method on 1 / sqrt(q) from below.
static float16 multiplier_of(__global const Factors *factors, const float16 *w, const float16 energy)
{
    const float16 bound = MAX(energy, (float16)1e-30f), per_root = inverse_root(bound);
    float16 multiplier = 0.0f;
    for (int k = 0; k < TERMS; k++) multiplier = MAX(multiplier, magnitude(w[k]) * per_root - factors->square[k]);
    for (int step = 0; step < 60; step++) {
        float16 q = 0.0f, slope = 0.0f;
        for (int k = 0; k < TERMS; k++) {
            const float16 share = 1.0f / (factors->square[k] + multiplier);
            const float16 root = w[k] * share, term = root * root;
            q += term;
            slope += term * share;
        }
        const int16 active = q > bound * (1.0f + 1e-6f);
        if (!ANY(active)) break;
        const float16 ratio = q / bound;
        multiplier += active ? q / slope * (ratio * inverse_root(ratio) - 1.0f) : (float16)0.0f;
    }
    return multiplier;
}

INNER static void fit_sixteen(
    __global const Factors *factors, __global const Sample *samples, const long stride, __global float *out,
    const long out_stride, const float unit)
{
    float16 w[TERMS], energy = 0.0f;
    SUM(0, BLOCK)
#if TERMS > BLOCK
    SUM(BLOCK, 2 * BLOCK)
#endif
#if TERMS > 2 * BLOCK
    SUM(2 * BLOCK, 3 * BLOCK)
#endif
#if TERMS > 3 * BLOCK
    SUM(3 * BLOCK, 4 * BLOCK)
#endif
#ifdef CONSTRAINED
    const float16 multiplier = multiplier_of(factors, w, energy);
    const int16 none = energy == 0.0f;
#else
    const float16 multiplier = 0.0f;
    const int16 none = 0;
#endif
    for (int k = 0; k < TERMS; k++) w[k] = none ? (float16)0.0f : w[k] / (factors->square[k] + multiplier);
    for (int i = 0; i < TERMS; i++) {
        float16 a = 0.0f, b = 0.0f;
        _Pragma("unroll") for (int k = 0; k + 1 < TERMS; k += 2) {
            a += factors->right[i][k] * w[k];
            b += factors->right[i][k + 1] * w[k + 1];
        }
        if (TERMS & 1) a += factors->right[i][TERMS - 1] * w[TERMS - 1];
        *(__global AnyWhere16 *)(out + i * out_stride) = a + b;
    }
}

// Columns `first` .. `first + columns - 1` of every row: out[row][term][column] from samples[sample][row][column].
// The strides count elements. The last sixteen columns overlap the ones before them, so there must be sixteen.
__kernel void fit(
    __global const Factors *factors, __global const Sample *samples, __global float *out, const int columns,
    const long sample_first, const long sample_stride, const long sample_row, const long out_first,
    const long out_stride, const long out_row, const float unit)
{
    const int row = get_global_id(1), begin = get_global_id(0) * 16 * GROUPS;
    for (int group = 0; group < GROUPS && begin + 16 * group < columns; group++) {
        const int column = min(begin + 16 * group, columns - 16);
        fit_sixteen(
            factors, samples + sample_first + row * sample_row + column, sample_stride,
            out + out_first + row * out_row + column, out_stride, unit);
    }
}
