// The light's pass: which triangle the nearest shadow starts on, and how far behind it.
// Host: torchmeso/render/shadow_map.py
//
// Compiled with SILHOUETTE and MIXED (see silhouette.clh).

#include "render/silhouette.clh"
#include "render/shadow_map.clh"

// Keeps what stops the light nearest: closed surfaces where the ray leaves them, open ones at the base of their slab.
static void block_stamp(const Place *place, const Rays *rays, __global const float16 *key, __global const int16 *slot,
                        const int filled, const int lanes, Ints *nearest, Floats *behind, Tally *tally)
{
    Floats start;
    start.vector = INFINITY;
    Ints next;
    next.vector = 0;
    const float size = (float)place->view->pixel_size;
    int active = lanes, first_round = 1;
    while (active) {
        Stretches found;
        const int candidates = next_stretches(place, rays, key, slot, filled, &active, &next, &start, first_round,
                                              &found, tally);
        first_round = 0;
        if (!candidates) break;
        // A light inside a solid lights that solid's surroundings; what nothing closes is taken at its front.
        int hit = candidates & ~found.inside;
        const int16 closed = found.back.vector >= 0;
        const Ints surface = {closed ? found.back.vector : found.front.vector};
        const float16 t = closed ? found.t_back.vector : found.t_front.vector;
        const Meeting met = meet(place, rays, hit, surface);
#if SILHOUETTE != 0
        // First by the facets alone; what they leave open asks for the surface at the back.
        int thin = thin_lanes(place, rays, hit & ~found.single, &found, 0, &met, 0, tally);
        hit &= ~thin;
        if (thin) {
            const Surface s = surface_at(place, rays, thin, found.back);
            const int close = thin_lanes(place, rays, thin, &found, &s, 0, 0, tally);
            hit |= thin & ~close;
            Floats at, reach;
            at.vector = INFINITY;
            if (close) hit |= test_silhouette(place, rays, close, &found, &s, 0, close, &at, &reach, tally);
        }
#endif
        tally->carved += __builtin_popcount(candidates & ~found.inside & ~hit);
        if (!hit) continue;
        const float16 lean = magnitude(met.slope), steep = MAX(lean, (float16)STEEPEST);
        const float16 texel = place->view->perspective ? size * t : (float16)size;
        const float16 bias = texel * (1.0f + SLOPE_BIAS * root(MAX(1.0f - steep * steep, (float16)0.0f)) / steep);
        float16 base = bias;
#if SILHOUETTE != 0
        const int open = hit & ~to_bits(closed);
        if (open) {
            Floats slab;
            slab.vector = 0.0f;
            for (int rest = open; rest; rest &= rest - 1) {
                const int l = __builtin_ctz(rest);
                __global const Mdf *mdf = place->mdfs + found.object.lane[l];
                if (mdf->there && place->labels[surface.lane[l]] & FRONT) slab.lane[l] = mdf->h;
            }
            const Surface s = surface_at(place, rays, open, surface);
            const float16 cosine = -dot3(s.n, rays->direction);
            base = s.scale * slab.vector / MAX(cosine, (float16)MIN_COS) + bias;
        }
#endif
        const float16 half_way = 0.5f * (t - found.t_front.vector);
        const float16 offset = closed ? -MIN(bias, half_way) : base;
        const int16 better = from_bits(hit) & (t + offset < start.vector);
        start.vector = better ? t + offset : start.vector;
        nearest->vector = better ? surface.vector : nearest->vector;
        behind->vector = better ? offset : behind->vector;
        // Nothing begins within the interval: what comes later lies behind.
        if (place->skips & SKIP_BEHIND) active &= ~(hit & to_bits(closed) & ~found.crowded);
    }
}

static INNER void draw_light_tiles(const int worker, __global const View *restrict views,
                                   __global const Triangle *restrict triangles, __global const Slot *restrict slots,
                                   __global const int *restrict labels,
                                   __global const int16 *restrict boxes, __global const int16 *restrict coarse,
                                   __global Counters *restrict counters,
                                   __global const float16 *restrict records, __global const Facet *restrict facets,
                                   __global const uchar *restrict tables, __global const Mdf *restrict mdfs,
                                   const int number, const int stride, const int capacity, const int skips,
                                   __global float16 *restrict key, __global int16 *restrict slot,
                                   __global Texel *restrict texels, __global uchar *restrict empty)
{
    __global const View *view = views + number;
    __global Counters *counted = counters + number;
    const int coarse_stride = ((stride >> 4) + 15) >> 4;
    const Place place = {view, slots + view->slots, labels + view->slots, records, facets, tables, mdfs,
                         counted->near_bodies, 0, skips};
    const int across = (view->width + TILE - 1) / TILE, down = (view->height + TILE - 1) / TILE;
    Lists lists;
    Tally tally = {0};
    while (1) {
        const int tile = atomic_inc(&counted->tile);
        if (tile >= across * down) break;
        const int x0 = tile % across * TILE, y0 = tile / across * TILE;
        const int room = worker * ROOM * STAMPS * STAMPS;
        if (!fill_tile(view, triangles + view->slots, boxes + 4 * (view->slots >> 4),
                       coarse + number * 4 * coarse_stride, counted->vectors, stride >> 4, x0, y0, room, &lists, key,
                       slot, &counted->used, capacity))
            continue;  // the host gives more room and asks again
        for (int s = 0; s < STAMPS * STAMPS; s++) {
            const int x = x0 + 4 * (s % STAMPS), y = y0 + 4 * (s / STAMPS);
            if (x >= view->width || y >= view->height) continue;
            const int filled = lists.filled[s], at = (y >> 2) * ((view->width + 3) >> 2) + (x >> 2);
            if (!filled && empty[at] && skips & SKIP_EMPTY) continue;
            empty[at] = !filled;
            Ints nearest;
            Floats behind;
            nearest.vector = -1;
            behind.vector = 0.0f;
            const int lanes = to_bits((x + LX < view->width) & (y + LY < view->height));
            if (filled) {
                const Rays rays = stamp_rays(view, x, y);
                block_stamp(&place, &rays, key + lists.begin[s], slot + lists.begin[s], filled, lanes, &nearest,
                            &behind, &tally);
            }
            if (x + 4 <= view->width && y + 4 <= view->height && view->width % 4 == 0) {
                const int16 a = nearest.vector, b = as_int16(behind.vector);
                const int8 rows[4] = {(int8)(a.s0, b.s0, a.s1, b.s1, a.s2, b.s2, a.s3, b.s3),
                                      (int8)(a.s4, b.s4, a.s5, b.s5, a.s6, b.s6, a.s7, b.s7),
                                      (int8)(a.s8, b.s8, a.s9, b.s9, a.sa, b.sa, a.sb, b.sb),
                                      (int8)(a.sc, b.sc, a.sd, b.sd, a.se, b.se, a.sf, b.sf)};
                for (int k = 0; k < 4; k++)
                    *(__global int8 *)(texels + view->texels + (y + k) * view->width + x) = rows[k];
                continue;
            }
            for (int rest = lanes; rest; rest &= rest - 1) {
                const int l = __builtin_ctz(rest);
                const Texel texel = {nearest.lane[l], behind.lane[l]};
                texels[view->texels + (y + (l >> 2)) * view->width + x + (l & 3)] = texel;
            }
        }
    }
    count_up(counted, &tally);
}

__kernel __attribute__((reqd_work_group_size(1, 1, 1)))
void draw_light(__global const View *restrict views, __global const Triangle *restrict triangles,
                __global const Slot *restrict slots, __global const int *restrict labels,
                __global const int16 *restrict boxes, __global const int16 *restrict coarse,
                __global Counters *restrict counters,
                __global const float16 *restrict records, __global const Facet *restrict facets,
                __global const uchar *restrict tables, __global const Mdf *restrict mdfs, const int number,
                const int stride, const int capacity, const int skips,
                __global float16 *restrict key, __global int16 *restrict slot,  // layers of the tiles at work
                __global Texel *restrict texels,
                __global uchar *restrict empty)  // (stamps) whether a stamp of the map holds nothing already
{
    draw_light_tiles(get_group_id(0), views, triangles, slots, labels, boxes, coarse, counters, records, facets,
                     tables, mdfs, number, stride, capacity, skips, key, slot, texels, empty);
}
