// Seams by dynamic programming, one patch per work-item.
// Host: torchmeso/synthesize/seam_dp.py, which also holds the formula in torch.

#define FAR (1L << 60)

// The first of three neighbours that costs least: -1, 0 or 1 from `at`.
static int cheapest(__global const long *restrict E, const int at, const int across)
{
    int to = 0;
    long least = at > 0 ? E[at - 1] : FAR;
    if (E[at] < least) least = E[at], to = 1;
    if (at + 1 < across && E[at + 1] < least) to = 2;
    return to - 1;
}

// E of eq. (5) over `n` steps of `across` places each, from the last step to the first. Place i of step k lies at
// e[k * step + i * side].
static void cumulate(__global const long *restrict e, const int step, const int side, const int n, const int across,
                     __global long *restrict E)
{
    for (int i = 0; i < across; i++) E[(n - 1) * across + i] = e[(n - 1) * step + i * side];
    for (int k = n - 2; k >= 0; k--) {
        __global const long *before = E + (k + 1) * across;
        for (int i = 0; i < across; i++) {
            const long left = i > 0 ? before[i - 1] : FAR, right = i + 1 < across ? before[i + 1] : FAR;
            long least = before[i] < left ? before[i] : left;
            least = right < least ? right : least;
            E[k * across + i] = e[k * step + i * side] + least;
        }
    }
}

// The path from step `first` at place `at` onwards; steps before it get `at` too.
static void trace(__global const long *restrict E, const int n, const int across, int at, const int first,
                  __global int *restrict path)
{
    for (int k = 0; k < n; k++) {
        if (k > first) at += cheapest(E + k * across, at, across);
        path[k] = at;
    }
}

static int first_least(__global const long *restrict E, const int across)
{
    int at = 0;
    for (int i = 1; i < across; i++) at = E[i] < E[at] ? i : at;
    return at;
}

__kernel void cut(const int height, const int width, const int left, const int top,
                  __global const long *restrict e,        // (B, height, width)
                  __global long *restrict scratch,        // (B, height * left + width * top)
                  __global int *restrict column,          // (B, height)
                  __global int *restrict row,             // (B, width)
                  __global long *restrict cost)           // (B)
{
    const int b = get_global_id(0);
    __global long *down = scratch + (size_t)b * (height * left + width * top), *across = down + height * left;
    e += (size_t)b * height * width;
    column += b * height;
    row += b * width;
    if (left) cumulate(e, width, 1, height, left, down);
    if (top) cumulate(e, 1, width, width, top, across);
    if (!left || !top) {
        const int at = left ? first_least(down, left) : first_least(across, top);
        if (left) trace(down, height, left, at, 0, column);
        else trace(across, width, top, at, 0, row);
        cost[b] = left ? down[at] : across[at];
        return;
    }
    int knee = 0;
    long least = FAR;
    for (int k = 0; k < (left < top ? left : top); k++) {
        const long whole = down[k * left + k] + across[k * top + k] - e[k * width + k];
        if (whole < least) least = whole, knee = k;
    }
    trace(down, height, left, knee, knee, column);
    trace(across, width, top, knee, knee, row);
    cost[b] = least;
}
