// The light's pass: the layers of each stamp of a shadow map, or at once what stops the light there.
// Host: torchmeso/render/shadow_map.py
//
// Compiled with SILHOUETTE and MIXED (see silhouette.clh), and GDM where there are shells.

#include "render/shadow_map.clh"

static INNER void draw_light_tiles(const int worker, const int number, const Place *place, const Shadows *shadows,
                                   __global const Triangle *restrict triangles, __global const int16 *restrict boxes,
                                   __global const int16 *restrict coarse, const int stride,
                                   const int capacity, const int room_to_keep, __global float16 *restrict key,
                                   __global int16 *restrict slot)
{
    __global const View *view = place->view;
    __global Counters *counted = shadows->counters + number;
    const int across = (view->width + TILE - 1) / TILE, down = (view->height + TILE - 1) / TILE;
    Lists lists;
    int some = 0;
    while (1) {
        const int tile = atomic_inc(&counted->tile);
        if (tile >= across * down) break;
        const int x0 = tile % across * TILE, y0 = tile / across * TILE;
        const int room = worker * ROOM * STAMPS * STAMPS;
        if (!fill_tile(view, triangles, boxes, coarse, counted->vectors, stride >> 4, x0, y0, room, &lists, key, slot,
                       &counted->used, capacity))
            continue;  // the host gives more room and asks again
        int total = 0;
        for (int s = 0; s < STAMPS * STAMPS; s++) total += lists.filled[s];
        int to = atomic_add(&shadows->counters->kept, total);
        if (to + total > room_to_keep) continue;
        for (int s = 0; s < STAMPS * STAMPS; s++) {
            const int x = x0 + 4 * (s % STAMPS), y = y0 + 4 * (s / STAMPS);
            if (x >= view->width || y >= view->height) continue;
            const int filled = lists.filled[s], from = lists.begin[s];
            const int own = view->stamps + (y >> 2) * ((view->width + 3) >> 2) + (x >> 2);
            const Passage passage = {to, filled};
            shadows->passages[own] = passage;
            for (int k = 0; k < filled; k++) {
                shadows->key[to + k] = key[from + k];
                shadows->slot[to + k] = slot[from + k];
            }
            to += filled;
            some += filled > 0;
            if (filled && !(place->skips & SKIP_UNSEEN)) draw_passage(place, shadows, number, own);
        }
    }
    atomic_add(&counted->stamps, some);
}

__kernel __attribute__((reqd_work_group_size(1, 1, 1)))
void draw_light(__global const View *restrict views, __global const Triangle *restrict triangles,
                __global const Slot *restrict slots, __global const Label *restrict labels,
                __global const int16 *restrict boxes, __global const int16 *restrict coarse,
                __global Counters *restrict counters,
                __global const float16 *restrict records, __global const Facet *restrict facets,
                __global const uchar *restrict tables, __global const Mdf *restrict mdfs, const int number,
                const int stride, const int capacity, const int room_to_keep, const int skips,
                __global float16 *restrict key, __global int16 *restrict slot,        // layers of the tiles at work
                __global Passage *restrict passages,                                  // (stamps of all maps)
                __global float16 *restrict kept_key, __global int16 *restrict kept_slot,  // (room_to_keep) their layers
                __global Blockers *restrict blockers                                  // (stamps of all maps)
                SHELL_PARAMETERS)
{
    __global const View *view = views + number;
    const int coarse_stride = ((stride >> 4) + 15) >> 4;
    const Place place = {view, slots + view->slots, labels + view->slots, records, facets, tables, mdfs,
                         counters[number].near_bodies, 0, skips SHELL_PLACE};
    const Shadows shadows = {views, slots, labels, counters, passages, kept_key, kept_slot, blockers};
    draw_light_tiles(get_group_id(0), number, &place, &shadows, triangles + view->slots,
                     boxes + 4 * (view->slots >> 4), coarse + number * 4 * coarse_stride, stride, capacity,
                     room_to_keep, key, slot);
}
