// Cuts of least cost through overlaps, one cut per work-item.
// Host: torchmeso/synthesize/seam_graphcut.py
//
// Texels stand in a grid with a border of absent ones around it, so that every texel has four neighbours. Directions:
// 0 left, 1 right, 2 up, 3 down; `d ^ 1` is the way back.

#define FREE 0
#define OLD 1
#define NEW 2
#define ABSENT 3

#define FAR (1L << 60)

static int apart(const int d, const int stride) { return d == 0 ? -1 : d == 1 ? 1 : d == 2 ? -stride : stride; }

// ---- Shortest paths in the dual: texels' corners, joined along the texels' sides ----
//
// The corner at the lower right of a texel has its number. Corners wait in buckets by distance, a ring of them, each
// corner in one at most; within a bucket the order is of no account: whatever gets nearer waits again.

#define BUCKETS 256

typedef struct {
    __global long *d;                        // (texels) distance
    __global int *next, *previous, *bucket;  // (texels) -1 = none
    int first[BUCKETS];
    int shift, waiting;
    long now;                                // number of the bucket at hand, not taken modulo
} Queue;

static void put_in(Queue *q, const int at, long bucket)
{
    if (bucket >= q->now + BUCKETS) bucket = q->now + BUCKETS - 1;  // looked at again from there
    const int b = (int)bucket & (BUCKETS - 1), first = q->first[b];
    q->bucket[at] = b;
    q->next[at] = first;
    q->previous[at] = -1;
    if (first >= 0) q->previous[first] = at;
    q->first[b] = at;
    q->waiting++;
}

static void take_out(Queue *q, const int at)
{
    const int before = q->previous[at], behind = q->next[at];
    if (before >= 0) q->next[before] = behind;
    else q->first[q->bucket[at]] = behind;
    if (behind >= 0) q->previous[behind] = before;
    q->bucket[at] = -1;
    q->waiting--;
}

static void reach(Queue *q, const int to, const long distance)
{
    if (distance >= q->d[to]) return;
    q->d[to] = distance;
    const long bucket = distance >> q->shift;
    if (q->bucket[to] >= 0) {
        if (((int)bucket & (BUCKETS - 1)) == q->bucket[to]) return;
        take_out(q, to);
    }
    put_in(q, to, bucket);
}

// What it costs to pass between two neighbours; -1 = they are held together, or one stands outside of the overlap's
// border and the other is held: terminals reach around it.
static int between(const int p, const int q, __global const uchar *restrict side, __global const int *restrict e,
                   const int border)
{
    const int a = side[p], b = side[q];
    if (a == ABSENT || b == ABSENT) return border && (a == OLD || b == OLD || a == NEW || b == NEW) ? -1 : 0;
    return a == b && a != FREE ? -1 : e[p] + e[q];
}

// Costs of the steps to the right and down from each corner; none leaves the overlap.
static void steps(const int rows, const int columns, __global const uchar *restrict side,
                  __global const int *restrict e, __global int *restrict right, __global int *restrict down)
{
    const int stride = columns + 2;
    for (int y = 0; y < rows + 2; y++)
        for (int x = 0; x < stride; x++) {
            const int p = y * stride + x;
            const int inside = y <= rows && x <= columns;
            right[p] = inside && x < columns ? between(p + 1, p + 1 + stride, side, e, y == 0 || y == rows) : -1;
            down[p] = inside && y < rows ? between(p + stride, p + 1 + stride, side, e, x == 0 || x == columns) : -1;
        }
}

__kernel void planar(const int rows, const int columns, const int start, const int end, const int shift,
                     __global const uchar *restrict side,  // (rows + 2, columns + 2)
                     __global const int *restrict cost,    // (B, rows + 2, columns + 2) e
                     __global long *restrict far,          // (B, rows + 2, columns + 2) scratch
                     __global int *restrict scratch,       // (B, 5, rows + 2, columns + 2)
                     __global uchar *restrict old,         // (B, rows + 2, columns + 2)
                     __global long *restrict value)        // (B)
{
    const int b = get_global_id(0), stride = columns + 2, n = (rows + 2) * stride;
    __global const int *e = cost + (size_t)b * n;
    __global int *right = scratch + (size_t)b * 5 * n, *down = right + n;
    __global long *d = far + (size_t)b * n;
    old += (size_t)b * n;
    Queue q = {d, right + 2 * n, right + 3 * n, right + 4 * n, {0}, shift, 0, 0};
    for (int k = 0; k < BUCKETS; k++) q.first[k] = -1;
    for (int p = 0; p < n; p++) {
        d[p] = FAR;
        q.bucket[p] = -1;
    }
    steps(rows, columns, side, e, right, down);
    reach(&q, start, 0);
    while (q.waiting) {
        const int at = q.first[(int)q.now & (BUCKETS - 1)];
        if (at < 0) {
            q.now++;
            if (d[end] >> shift < q.now) break;  // nothing that waits is nearer
            continue;
        }
        take_out(&q, at);
        const long here = d[at];
        if (here >> shift > q.now) {
            put_in(&q, at, here >> shift);
            continue;
        }
        if (right[at] >= 0) reach(&q, at + 1, here + right[at]);
        if (down[at] >= 0) reach(&q, at + stride, here + down[at]);
        if (at >= 1 && right[at - 1] >= 0) reach(&q, at - 1, here + right[at - 1]);
        if (at >= stride && down[at - stride] >= 0) reach(&q, at - stride, here + down[at - stride]);
    }
    const long D = d[end];
    value[b] = D;
    // Differences of distances, none above D, are a flow. What has capacity left from the old ones is old too.
    for (int p = 0; p < n; p++) d[p] = min(d[p], D);
    __global int *todo = q.next;
    int last = 0;
    for (int p = 0; p < n; p++) {
        old[p] = side[p] == OLD;
        if (old[p]) todo[last++] = p;
    }
    for (int next = 0; next < last; next++) {
        const int p = todo[next], up = p - stride - 1;
        // The flow to each neighbour: the distance on the right, as one goes, less that on the left.
        const long flow[4] = {d[up] - d[up + stride], d[p] - d[up + 1], d[up + 1] - d[up], d[up + stride] - d[p]};
        for (int way = 0; way < 4; way++) {
            const int to = p + apart(way, stride);
            if (old[to] || side[to] == ABSENT || side[to] == NEW || e[p] + e[to] <= flow[way]) continue;
            old[to] = 1;
            todo[last++] = to;
        }
    }
}

// ---- Flow on the grid, as boykov2004experimental describes it: two trees that grow, augment and adopt ----

#define TERMINAL 4  // what a texel's parent is, where it is not in a direction
#define ORPHAN 5
#define NONE 6
#define SINK 1
#define ACTIVE 2

typedef struct {
    int stride, texels;
    __global int *rest;      // (texels, 4) capacity left to each neighbour
    __global long *terminal; // capacity left from the source, or below zero to the sink
    __global int *stamp, *far;
    __global int *active, *orphans;  // rings
    __global uchar *parent, *tree;
    int first_active, actives, first_orphan, orphaned, time;
} Trees;

static void activate(Trees *t, const int p)
{
    if (t->tree[p] & ACTIVE) return;
    t->tree[p] |= ACTIVE;
    int at = t->first_active + t->actives++;
    if (at >= t->texels) at -= t->texels;
    t->active[at] = p;
}

static void orphan_first(Trees *t, const int p)
{
    t->parent[p] = ORPHAN;
    t->first_orphan = (t->first_orphan ? t->first_orphan : t->texels) - 1;
    t->orphans[t->first_orphan] = p;
    t->orphaned++;
}

static void orphan_last(Trees *t, const int p)
{
    t->parent[p] = ORPHAN;
    int at = t->first_orphan + t->orphaned++;
    if (at >= t->texels) at -= t->texels;
    t->orphans[at] = p;
}

// Capacity left along direction `d` from p to q, or in a tree of the sink from q to p.
static int rest(const Trees *t, const int sink, const int p, const int d, const int q)
{
    return sink ? t->rest[4 * q + (d ^ 1)] : t->rest[4 * p + d];
}

// Grow the tree of p. The return is the direction in which it meets the other tree, or -1.
static int grow(Trees *t, const int p)
{
    const int sink = t->tree[p] & SINK;
    for (int d = 0; d < 4; d++) {
        const int q = p + apart(d, t->stride);
        if (rest(t, sink, p, d, q) <= 0) continue;
        if (t->parent[q] == NONE) {
            t->tree[q] = (t->tree[q] & ACTIVE) | sink;
            t->parent[q] = d ^ 1;
            t->stamp[q] = t->stamp[p];
            t->far[q] = t->far[p] + 1;
            activate(t, q);
        } else if ((t->tree[q] & SINK) != sink) {
            return d;
        } else if (t->stamp[q] <= t->stamp[p] && t->far[q] > t->far[p]) {
            t->parent[q] = d ^ 1;  // a shorter way to the terminal
            t->stamp[q] = t->stamp[p];
            t->far[q] = t->far[p] + 1;
        }
    }
    return -1;
}

// Push what can be pushed along the path through a -> a + d. The return is how much that is.
static long augment(Trees *t, const int a, const int d)
{
    const int b = a + apart(d, t->stride);
    long most = t->rest[4 * a + d];
    for (int sink = 0; sink < 2; sink++) {
        int p = sink ? b : a;
        while (t->parent[p] != TERMINAL) {
            const int up = t->parent[p], q = p + apart(up, t->stride);
            most = min(most, (long)rest(t, !sink, p, up, q));
            p = q;
        }
        most = min(most, sink ? -t->terminal[p] : t->terminal[p]);
    }
    t->rest[4 * a + d] -= most;
    t->rest[4 * b + (d ^ 1)] += most;
    for (int sink = 0; sink < 2; sink++) {
        int p = sink ? b : a;
        while (t->parent[p] != TERMINAL) {
            const int up = t->parent[p], q = p + apart(up, t->stride);
            t->rest[4 * p + up] += sink ? -most : most;
            t->rest[4 * q + (up ^ 1)] += sink ? most : -most;
            if (rest(t, !sink, p, up, q) == 0) orphan_first(t, p);
            p = q;
        }
        t->terminal[p] += sink ? most : -most;
        if (t->terminal[p] == 0) orphan_first(t, p);
    }
    return most;
}

// How far q stands from its terminal, or -1 where its tree is broken above it.
static int origin(const Trees *t, int q)
{
    int steps = 0;
    for (;;) {
        if (t->stamp[q] == t->time) return steps + t->far[q];
        const int up = t->parent[q];
        if (up == TERMINAL) {
            t->stamp[q] = t->time;
            t->far[q] = 1;
            return steps + 1;
        }
        if (up == ORPHAN || up == NONE) return -1;
        q += apart(up, t->stride);
        steps++;
    }
}

static void adopt(Trees *t)
{
    while (t->orphaned) {
        const int p = t->orphans[t->first_orphan];
        if (++t->first_orphan == t->texels) t->first_orphan = 0;
        t->orphaned--;
        const int sink = t->tree[p] & SINK;
        int found = NONE, least = INT_MAX;
        for (int d = 0; d < 4; d++) {
            int q = p + apart(d, t->stride);
            if (rest(t, !sink, p, d, q) <= 0 || t->parent[q] == NONE || (t->tree[q] & SINK) != sink) continue;
            int far = origin(t, q);
            if (far < 0) continue;
            if (far < least) least = far, found = d;
            for (; t->stamp[q] != t->time; q += apart(t->parent[q], t->stride)) {
                t->stamp[q] = t->time;
                t->far[q] = far--;
            }
        }
        t->parent[p] = found;
        if (found != NONE) {
            t->stamp[p] = t->time;
            t->far[p] = least + 1;
            continue;
        }
        for (int d = 0; d < 4; d++) {
            const int q = p + apart(d, t->stride), up = t->parent[q];
            if (up == NONE || (t->tree[q] & SINK) != sink) continue;
            if (rest(t, !sink, p, d, q) > 0) activate(t, q);
            if (up == (d ^ 1)) orphan_last(t, q);
        }
    }
}

__kernel void flow(const int rows, const int columns,
                   __global const uchar *restrict side,   // (rows + 2, columns + 2)
                   __global const int *restrict errors,   // (rows + 2, columns + 2) of keeping what is old
                   __global const int *restrict cost,     // (B, rows + 2, columns + 2) e
                   __global long *restrict terminals,     // (B, rows + 2, columns + 2) scratch
                   __global int *restrict scratch,        // (B, 8, rows + 2, columns + 2)
                   __global uchar *restrict trees,        // (B, 2, rows + 2, columns + 2) scratch
                   __global uchar *restrict old,          // (B, rows + 2, columns + 2)
                   __global long *restrict value)         // (B)
{
    const int b = get_global_id(0), stride = columns + 2, n = (rows + 2) * stride;
    __global const int *e = cost + (size_t)b * n;
    __global int *room = scratch + (size_t)b * 8 * n;
    __global uchar *marks = trees + (size_t)b * 2 * n;
    Trees trees_of = {stride, n, room, terminals + (size_t)b * n, room + 4 * n, room + 5 * n, room + 6 * n, room + 7 * n,
                      marks, marks + n, 0, 0, 0, 0, 1};
    Trees *t = &trees_of;
    for (int p = 0; p < n; p++) {
        const int kind = side[p];
        for (int d = 0; d < 4; d++) {
            const int q = p + apart(d, stride);
            t->rest[4 * p + d] = kind == ABSENT || side[q] == ABSENT ? 0 : e[p] + e[q];
        }
        const long terminal = kind == OLD ? FAR : kind == NEW ? -FAR : kind == FREE ? -(long)errors[p] : 0;
        t->terminal[p] = terminal;
        t->tree[p] = terminal < 0 ? SINK : 0;
        t->parent[p] = terminal ? TERMINAL : NONE;
        t->stamp[p] = 0;
        t->far[p] = 1;
        if (terminal) activate(t, p);
    }
    long total = 0;
    int p = -1;
    for (;;) {
        if (p < 0 || t->parent[p] == NONE) {
            if (!t->actives) break;
            p = t->active[t->first_active];
            if (++t->first_active == n) t->first_active = 0;
            t->actives--;
            t->tree[p] &= ~ACTIVE;
            if (t->parent[p] == NONE) continue;
        }
        const int d = grow(t, p);
        if (d < 0) {
            p = -1;
            continue;
        }
        t->time++;
        total += t->tree[p] & SINK ? augment(t, p + apart(d, stride), d ^ 1) : augment(t, p, d);
        adopt(t);
    }
    // The tree of the source is all that has capacity left from it: the least set of old ones.
    for (int q = 0; q < n; q++) old[(size_t)b * n + q] = side[q] != ABSENT && t->parent[q] != NONE && !(t->tree[q] & SINK);
    value[b] = total;
}
