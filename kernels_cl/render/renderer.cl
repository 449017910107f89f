// A frame: tiles of the camera's picture are filled, tested and shaded while they lie in the cache.
// Host: torchmeso/render/renderer.py
//
// Compiled with SILHOUETTE and MIXED (see silhouette.clh), ONE_LAYER, SHADOWS where lights have maps, FILTERED where
// pixels average what they cover, HARMONICS where there are double-SH or SH + PCA BTFs, QUILTED where there
// are quilting maps, GDM where there are shells, DISTANT where light comes from all around, and TRANSFER where that was
// followed to the vertices.

#include "render/look.clh"

static INNER void draw_tiles(const int worker, __global const View *restrict view,
                             __global const Triangle *restrict triangles, __global const Slot *restrict slots,
                             __global const Label *restrict labels,
                             __global const int16 *restrict boxes, __global const int16 *restrict coarse,
                             __global Counters *restrict counters,
                             __global const float16 *restrict records, __global const Facet *restrict facets,
                             __global const uchar *restrict tables, __global const Mdf *restrict mdfs,
                             __global const Reflectance *restrict reflectances, __global const Light *restrict lights,
                             __global const View *restrict light_views, __global const Slot *restrict light_slots,
                             __global const Label *restrict light_labels, __global Counters *restrict light_counters,
                             __global Passage *restrict passages, __global float16 *restrict kept_key,
                             __global int16 *restrict kept_slot, __global Blockers *restrict blockers,
                             __global const Frame *restrict frame, __global float16 *restrict key,
                             __global int16 *restrict slot, __global uchar4 *restrict shown,
                             __global float4 *restrict rgba, __global float *restrict depth,
                             __global int *restrict owner, __global uchar *restrict shadowed,
                             __global uchar *restrict empty SHELL_PARAMETERS DISTANT_PARAMETERS)
{
    const Place place = {view, slots, labels, records, facets, tables, mdfs, counters->near_bodies, 1,
                         frame->skips SHELL_PLACE DISTANT_PLACE};
    const Shadows shadows = {light_views, light_slots, light_labels, light_counters,
                             passages, kept_key, kept_slot, blockers};
    const Target target = {frame, reflectances, lights, shadows, shown, rgba, depth, owner, shadowed};
    const int across = (view->width + TILE - 1) / TILE, down = (view->height + TILE - 1) / TILE;
    Lists lists;
    Tally tally = {0};
    int skipped = 0;
    const float4 background = {frame->background[0], frame->background[1], frame->background[2], 0.0f};
    const uchar16 shown_background = encode((float16)(background, background, background, background));
    const int plane = frame->pitch * ((view->height + 3) & ~3);
    while (1) {
        const int tile = atomic_inc(&counters->tile);
        if (tile >= across * down) break;
        const int x0 = tile % across * TILE, y0 = tile / across * TILE;
        const int room = worker * ROOM * STAMPS * STAMPS;
        if (!fill_tile(view, triangles, boxes, coarse, counters->vectors, frame->stride >> 4, x0, y0, room, &lists, key,
                       slot, &counters->used, frame->capacity))
            continue;  // the host gives more room and asks again
        for (int s = 0; s < STAMPS * STAMPS; s++) {
            const int x = x0 + 4 * (s % STAMPS), y = y0 + 4 * (s / STAMPS);
            if (x >= view->width || y >= view->height) continue;
            const int filled = lists.filled[s], at = (y >> 2) * (frame->pitch >> 2) + (x >> 2);
            const int nothing = !filled && !frame->starts;
            if (nothing && empty[at] && frame->skips & SKIP_EMPTY) {
                skipped++;
                continue;
            }
            empty[at] = nothing;
            if (nothing) {
                clear_stamp(frame, plane, x, y, background, shown_background, shown, rgba, depth, owner, shadowed);
                continue;
            }
            const Rays rays = stamp_rays(view, x, y);
            const int lanes = to_bits((x + LX < view->width) & (y + LY < view->height));
            __global const float16 *key_of = key + lists.begin[s];
            const int near = filled ? lanes & to_bits(key_of[0] < INFINITY) : 0;
            tally.covered += __builtin_popcount(near);
            tally.deepest = MAX(tally.deepest, filled);
            for (int k = 0; k < filled; k++)
                tally.fragments += __builtin_popcount(lanes & to_bits(key_of[k] < INFINITY));
#ifdef SHADOWS
            // What is seen lies near the first fragment: its shadow is asked for before all else.
            const float16 first = view->perspective ? -rays.stretch / key_of[0] : key_of[0];
            const Vector3 nearest = {rays.origin.x + first * rays.direction.x, rays.origin.y + first * rays.direction.y,
                                     rays.origin.z + first * rays.direction.z};
            for (int i = 0; near && i < frame->lights; i++)
                if (lights[i].faces == 1) fetch_shadow_ahead(&shadows, lights[i].first_face, &nearest, near);
#endif
            const Seen seen = look(&place, &rays, key_of, slot + lists.begin[s], filled, lanes, &target, &tally);
            draw_stamp(&place, &target, &rays, &seen, &tally);
        }
    }
    count_up(counters, &tally);
    atomic_add(&counters->empty, skipped);
}

__kernel __attribute__((reqd_work_group_size(1, 1, 1)))
void draw(__global const View *restrict view, __global const Triangle *restrict triangles,
          __global const Slot *restrict slots, __global const Label *restrict labels,
          __global const int16 *restrict boxes, __global const int16 *restrict coarse,
          __global Counters *restrict counters,
          __global const float16 *restrict records, __global const Facet *restrict facets,
          __global const uchar *restrict tables, __global const Mdf *restrict mdfs,
          __global const Reflectance *restrict reflectances, __global const Light *restrict lights,
          __global const View *restrict light_views, __global const Slot *restrict light_slots,
          __global const Label *restrict light_labels, __global Counters *restrict light_counters,
          __global Passage *restrict passages, __global float16 *restrict kept_key, __global int16 *restrict kept_slot,
          __global Blockers *restrict blockers,  // of lights; as `draw_light` has them
          __global const Frame *restrict frame,
          __global float16 *restrict key, __global int16 *restrict slot,  // layers of the tiles at work
          __global uchar4 *restrict shown,     // (H, pitch) sRGB, and 255 where an object is seen
          __global float4 *restrict rgba,      // (H, pitch) linear colour, and whether an object is seen
          __global float *restrict depth,      // (H, pitch)
          __global int *restrict owner,        // (H, pitch)
          __global uchar *restrict shadowed,   // (light, H, pitch)
          __global uchar *restrict empty       // (stamps) whether a stamp already shows the background
          SHELL_PARAMETERS DISTANT_PARAMETERS)
{
    draw_tiles(get_group_id(0), view, triangles, slots, labels, boxes, coarse, counters, records, facets, tables,
               mdfs, reflectances, lights, light_views, light_slots, light_labels, light_counters, passages, kept_key,
               kept_slot, blockers, frame, key, slot, shown, rgba, depth, owner, shadowed, empty SHELL_ARGUMENTS DISTANT_ARGUMENTS);
}
