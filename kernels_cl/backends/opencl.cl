// Self-test of the device: y = 2 x + 1, one work-item per 16 values.
// Host: torchmeso/backends/opencl.py

__kernel void self_test(__global const float16 *restrict x,  // (64, 16)
                        __global float16 *restrict y)        // (64, 16)
{
    const int i = get_global_id(0);
    y[i] = 2.0f * x[i] + 1.0f;
}
