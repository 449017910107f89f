// A frame: tiles of the camera's picture are filled, tested and shaded while they lie in the cache.
// Host: torchmeso/render/renderer.py
//
// Compiled with SILHOUETTE and MIXED (see silhouette.clh), ONE_LAYER, SHADOWS where lights have maps, FILTERED where
// pixels average what they cover, HARMONICS where there are double-SH or SH + PCA BTFs, QUILTED where there
// are quilting maps, and GDM where there are shells.

#include "data/sh_pca_btf.clh"
#include "data/textured.clh"
#include "render/lights.clh"
#include "render/shadow_map.clh"
#ifdef GDM
#include "render/gdm_shade.clh"
#endif

// What a frame is shaded with, and where it goes.
typedef struct {
    __global const Frame *frame;
    __global const Reflectance *reflectances;
    __global const Light *lights;
    Shadows shadows;
    __global uchar4 *shown;
    __global float4 *rgba;
    __global float *depth;
    __global int *owner;
    __global uchar *shadowed;
} Target;

// What the lanes of a stamp show.
typedef struct {
    Surface at;
    Vector3 position;
    Ints object;
    Floats depth;
    int seen, inside;
#ifdef GDM
    float16 z;       // in the slab
    int met, floor;  // lanes that show what lies in a shell, and of these its bottom
#endif
} Seen;

// The lanes of `bits` whose normals lean towards a light: in the others its shadow decides nothing.
static int facing(__global const Light *light, const Vector3 *normal, const Vector3 *position, const int bits)
{
    float16 falloff;
    return bits & to_bits(dot3(toward(light, position, &falloff), *normal) > 0.0f);
}

#ifdef HARMONICS
#define DIFFUSE (!eigen && !harmonic)
#else
#define DIFFUSE (!eigen)
#endif

// Radiance of the points of one object in the lanes `bits`, added to `rgb`.
static void shade_object(const Place *place, __global const Reflectance *reflectance, __global const Light *lights,
                         __global const Frame *frame, const Rays *rays, const Seen *seen, const int bits,
                         const int *blocked, float4 *rgb, Tally *tally)
{
    __global const uchar *tables = place->tables;
    const Vector3 towards = {-rays->direction.x, -rays->direction.y, -rays->direction.z};
    const Vector3 wo = to_local(&seen->at, towards);
    const int eigen = reflectance->there == EIGEN;
#ifdef HARMONICS
    const int components = reflectance->there == HARMONIC_PCA;
    const int harmonic = components || reflectance->there == HARMONIC;
    Contracted contracted;
#endif
    Footprint view;
    Area area;
    Weights first;
    Vector3 normal;
    float4 T[16], albedo[16];
    float16 pixel = frame->pixel / seen->at.scale;
    if (place->view->perspective) {
        const Vector3 from_eye = {seen->position.x - rays->origin.x, seen->position.y - rays->origin.y,
                                  seen->position.z - rays->origin.z};
        const float16 depth = dot3(from_eye, rays->direction) / rays->stretch;
        pixel *= MAX(depth, (float16)0.0f);
    }
    if (DIFFUSE) {
        normal = diffuse_at(tables, reflectance, seen->at.u, seen->at.v, wo, pixel, bits, albedo);
#ifdef HARMONICS
    } else if (harmonic) {
        look_around(tables, reflectance->quilt, TABLE(Level, tables, reflectance->levels), reflectance->level_count,
                    seen->at.u, seen->at.v, wo, pixel, MOST_PROBES, bits, &area);
        if (components) contract_components(tables, reflectance, wo, &area, bits, &contracted);
        else contract(tables, reflectance, wo, &area, bits, &contracted);
#endif
    } else {
        view = footprint(TABLE(Ring, tables, reflectance->view_rings), reflectance->view_count, wo);
        look_around(tables, reflectance->quilt, TABLE(Level, tables, reflectance->levels), reflectance->level_count,
                    seen->at.u, seen->at.v, wo, pixel, MOST_PROBES, bits, &area);
        first = view_weights(tables, reflectance, 0, &view, bits);
    }
    int lit = 0;

    for (int i = 0; i < frame->lights; i++) {
        __global const Light *light = lights + i;
        float16 falloff;
        const Vector3 wi_world = toward(light, &seen->position, &falloff);
        const Vector3 wi = to_local(&seen->at, wi_world);
        const float4 power = {light->power[0], light->power[1], light->power[2], 0.0f};
        const float most = MAX(MAX(power.x, power.y), power.z);
        const int arrives = bits & ~blocked[i] & to_bits((wi.z > 0.0f) & (falloff * most > 0.0f));
        lit |= arrives;
        if (!arrives) continue;
        if (DIFFUSE) {
            const Floats part = {falloff * MAX(dot3(normal, wi), (float16)0.0f) * (1.0f / PI)};
            for (int b = arrives; b; b &= b - 1) {
                const int l = __builtin_ctz(b);
                rgb[l] += power * albedo[l] * part.lane[l];
            }
            continue;
        }
        float16 horizon = wi.z / reflectance->last_cosine;
        horizon = horizon > 1.0f ? 1.0f : horizon;
        const Floats arriving = {falloff * horizon * (1.0f / PI)};
#ifdef HARMONICS
        if (harmonic) {
            reflect_harmonics(tables, reflectance, wi, &contracted, arrives, T);
        } else
#endif
        {
            const Footprint from =
                footprint(TABLE(Ring, tables, reflectance->light_rings), reflectance->light_count, wi);
            reflect(tables, reflectance, frame->rank_error, &view, &first, &area, &from, arrives, T, &tally->spared);
        }
        for (int b = arrives; b; b &= b - 1) {
            const int l = __builtin_ctz(b);
            rgb[l] += not_negative(T[l]) * power * arriving.lane[l];
        }
    }

    const int dark = frame->ambient_paper ? bits & ~lit : bits;
    if (frame->ambient <= 0.0f || !dark) return;
    if (DIFFUSE) {
        const Floats open = {0.5f * (1.0f + normal.z)};
        for (int b = dark; b; b &= b - 1) {
            const int l = __builtin_ctz(b);
            rgb[l] += frame->ambient * open.lane[l] * albedo[l];
        }
        return;
    }
    // Light from everywhere shows little of what is small: one place is enough.
    const int several = area.count > 1;
    if (several)
        look_around(tables, reflectance->quilt, TABLE(Level, tables, reflectance->levels), reflectance->level_count,
                    seen->at.u, seen->at.v, wo, pixel, 1, bits, &area);
#ifdef HARMONICS
    if (harmonic) {
        if (several && components) contract_components(tables, reflectance, wo, &area, dark, &contracted);
        if (several && !components) contract(tables, reflectance, wo, &area, dark, &contracted);
        ambient_harmonics(tables, reflectance, &contracted, dark, T);
    } else
#endif
        reflect_ambient(tables, reflectance, &view, &first, &area, dark, T);
    for (int b = dark; b; b &= b - 1) rgb[__builtin_ctz(b)] += frame->ambient * not_negative(T[__builtin_ctz(b)]);
}

// Four colours as they are shown: exposure 0, clipped, sRGB, as data/image.py does; 2^x is a polynomial.
static uchar16 encode(const float16 colour)
{
    float16 x = colour > 0.0f ? colour : (float16)0.0f;
    x = x < 1.0f ? x : (float16)1.0f;
    const float16 log2 = log2_(x + 1e-9f) * (1.0f / 2.4f);
    const int16 whole = TO_INT(log2 - 0.5f);
    const float16 f = log2 - TO_FLOAT(whole);
    float16 exp2 = 1.8775767e-3f;
    exp2 = exp2 * f + 8.9893397e-3f;
    exp2 = exp2 * f + 5.5826318e-2f;
    exp2 = exp2 * f + 2.4015361e-1f;
    exp2 = exp2 * f + 6.9315308e-1f;
    exp2 = exp2 * f + 9.9999994e-1f;
    const float16 power = 1.055f * exp2 * as_float16((whole + 127) << 23) - 0.055f;
    float16 shown = x <= 0.0031308f ? 12.92f * x : power;
    shown.s3 = x.s3, shown.s7 = x.s7, shown.sb = x.sb, shown.sf = x.sf;
    return __builtin_convertvector(TO_INT(shown * 255.0f + 0.5f), uchar16);
}

// Shades what the lanes of a stamp show and writes it.
static void draw_stamp(const Place *place, const Target *target, const Rays *rays, const Seen *seen, Tally *tally)
{
    __global const Frame *frame = target->frame;
    __global const Light *lights = target->lights;
    const int shaded = seen->seen & ~seen->inside;
    const int plane = frame->pitch * ((place->view->height + 3) & ~3);
    float4 colour[16];  // rgb and whether an object is seen
    const float4 background = {frame->background[0], frame->background[1], frame->background[2], 0.0f};
    for (int l = 0; l < 16; l++) colour[l] = seen->seen >> l & 1 ? (float4)(0.0f, 0.0f, 0.0f, 1.0f) : background;
    int blocked[MAX_LIGHTS];
    float16 slack = 0.0f;
#ifdef GDM
    Matter matter;
    const Place3 in_slab = {seen->at.u, seen->at.v, seen->z};
    const Vector3 towards = {-rays->direction.x, -rays->direction.y, -rays->direction.z};
    const Vector3 wo = to_local(&seen->at, towards);
    for (int rest = shaded & seen->met; rest;) {
        int object;
        const int same = of_one_object(&seen->object, rest, &object);
        rest &= ~same;
        slack = from_bits(same) ? place->gdms[object].h * seen->at.scale : slack;
        material_of(place->gdm_tables, place->gdms + object, &in_slab, wo, seen->floor, same, &matter);
    }
#endif
    const float16 d = from_bits(shaded) ? seen->depth.vector : (float16)0.0f;
    const Vector3 receiver = {rays->origin.x + d * rays->direction.x, rays->origin.y + d * rays->direction.y,
                              rays->origin.z + d * rays->direction.z};
    const Vector3 sunk = {receiver.x - seen->position.x, receiver.y - seen->position.y, receiver.z - seen->position.z};
    const float16 way = root(dot3(sunk, sunk));
#ifdef GDM
    const int16 below = from_bits(shaded & ~seen->met) & (way > 0.0f);
#else
    const int16 below = from_bits(shaded) & (way > 0.0f);
#endif
    const float16 reach = below ? 2.0f * way : (float16)INFINITY;
    for (int i = 0; i < frame->lights; i++) {
        int asked = place->skips & SKIP_FACING && !(frame->outputs & OWNER)
                  ? facing(lights + i, &seen->at.n, &seen->position, shaded) : shaded;
#ifdef GDM
        if (place->skips & SKIP_FACING && !(frame->outputs & OWNER) && seen->met)  // it has normals of its own
            asked = (asked & ~seen->met) |
                    faces_light(lights + i, &seen->at, &seen->position, &matter, shaded & seen->met);
#endif
        tally->averted += __builtin_popcount(shaded & ~asked);
        const int first = lights[i].first_face, count = lights[i].faces;
#ifdef SHADOWS
        int deep = 0;
        blocked[i] = asked ? blocked_from(place, &target->shadows, first, count, &receiver, slack, reach, asked, &deep)
                           : 0;
        deep &= ~blocked[i];
        if (deep)  // what a body's crease has swallowed is as dark as the surface above it
            blocked[i] |= blocked_from(place, &target->shadows, first, count, &seen->position, slack,
                                       (float16)INFINITY, deep, &deep);
#else
        blocked[i] = 0;
#endif
        if (!(frame->outputs & OWNER)) continue;
        for (int l = 0; l < 16; l++)
            target->shadowed[i * plane + (rays->y + (l >> 2)) * frame->pitch + rays->x + (l & 3)] = blocked[i] >> l & 1;
    }
    for (int rest = shaded; rest;) {
        int object;
        int same = of_one_object(&seen->object, rest, &object);
#ifdef GDM
        const int met = same & seen->met;
        if (met) {
            shade_shell(place->gdm_tables, place->gdms + object, lights, frame, rays, &seen->at, &seen->position,
                        seen->z, &matter, met, blocked, colour);
            same = met;
        } else
#endif
        shade_object(place, target->reflectances + object, lights, frame, rays, seen, same, blocked, colour, tally);
        rest &= ~same;
    }
    const Ints objects = {from_bits(seen->inside) ? (int16)-2 : seen->object.vector};
    for (int row = 0; row < 4; row++) {
        const int first = (rays->y + row) * frame->pitch + rays->x;
        if (frame->outputs & DISPLAY) {
            *(__global uchar16 *)(target->shown + first) = encode(*(const float16 *)(colour + 4 * row));
            continue;
        }
        for (int k = 0; k < 4; k++) target->rgba[first + k] = colour[4 * row + k];
        if (frame->outputs & OWNER) {
            *(__global float4 *)(target->depth + first) = *(const float4 *)(seen->depth.lane + 4 * row);
            *(__global int4 *)(target->owner + first) = *(const int4 *)(objects.lane + 4 * row);
        }
    }
}

#ifdef GDM
// What rays meet first in shells that the eye is inside of; returns whether it is inside of any.
static int look_from_within(const Place *place, const Rays *rays, __global const Frame *frame, const int lanes,
                            Seen *seen, Tally *tally)
{
    for (int i = 0; i < frame->starts; i++) {
        const int object = frame->start_surface[i];
        Met met;
        const int hit = walk(&place->shells, place->gdm_tables, place->gdms + object, &rays->origin, &rays->direction,
                             (float16)0.0f, lanes, (int16)(frame->start_tet[i] << 2), frame->start_place[i], &met);
        tally->prisms += met.prisms;
        tally->tets += met.steps;
        tally->endless += __builtin_popcount(met.endless);
        tally->carried += met.carried;
        if (i == 0) {
            const Vector3 up = {0.0f, 0.0f, 1.0f}, along = {1.0f, 0.0f, 0.0f};
            seen->at = framed(up, along, (float16)1.0f);
            seen->position = rays->origin;
        }
        const int bits = hit & to_bits(met.t.vector < seen->depth.vector);
        const int16 better = from_bits(bits);
        const float16 t = MAX(met.t.vector, (float16)0.0f);
        surface_in_shell(place->shells.prisms, place->records, &met, bits, &seen->at);
        seen->seen |= bits;
        seen->met |= bits;
        seen->floor = (seen->floor & ~bits) | (bits & met.floor);
        seen->z = better ? met.place.z : seen->z;
        seen->depth.vector = better ? t : seen->depth.vector;
        seen->object.vector = better ? (int16)object : seen->object.vector;
        seen->position.x = better ? rays->origin.x + t * rays->direction.x : seen->position.x;
        seen->position.y = better ? rays->origin.y + t * rays->direction.y : seen->position.y;
        seen->position.z = better ? rays->origin.z + t * rays->direction.z : seen->position.z;
    }
    return frame->starts > 0;
}
#endif

// What the rays of a stamp end on: the nearest of all stretches that stop them.
static Seen look(const Place *place, const Rays *rays, __global const float16 *key, __global const int16 *slot,
                 const int filled, const int lanes, const Target *target, Tally *tally)
{
    __global const Frame *frame = target->frame;
    Seen seen;
    seen.depth.vector = INFINITY;
    seen.object.vector = -1;
    seen.seen = seen.inside = 0;
#ifdef GDM
    seen.met = seen.floor = 0;
    seen.z = 0.0f;
#endif
    Ints next;
    next.vector = 0;
    int active = filled ? lanes : 0, first_round = 1, first_seen = 1;
#ifdef GDM
    first_seen = !look_from_within(place, rays, frame, lanes, &seen, tally);
#endif
    while (active) {
        Stretches found;
        const int candidates = next_stretches(place, rays, key, slot, filled, &active, &next, &seen.depth, first_round,
                                              &found, tally);
        first_round = 0;
        if (!candidates) break;
        int hit = candidates;
        const float16 length = found.t_back.vector - found.t_front.vector;
#ifdef GDM
        Met met;
        int entering;
        const int missed = pass_shells(place, rays, candidates & ~found.inside, &found, &met, &entering, tally);
        Surface s = surface_at(place, rays, candidates & ~found.inside & ~entering, found.front);
        hit &= ~missed;
        entering &= hit;
#else
        const Surface s = surface_at(place, rays, candidates & ~found.inside, found.front);
#endif
        const float16 t = found.t_front.vector;
        Vector3 position = {rays->origin.x + t * rays->direction.x, rays->origin.y + t * rays->direction.y,
                            rays->origin.z + t * rays->direction.z};
#if SILHOUETTE != 0
        // How deep the mesostructure lies is asked where it is written, where a shadow may fall, and where it decides
        // what is in front.
        int deep = frame->depths ? candidates : 0;
        if (place->skips & SKIP_FACING && !(frame->outputs & OWNER)) {
            deep = 0;
            for (int i = 0; i < frame->lights && frame->depths && deep != candidates; i++)
                deep |= facing(target->lights + i, &s.n, &position, candidates & ~deep);
        }
        deep |= found.crowded | found.single;
        Floats reach, at;
        reach.vector = -1.0f;
        at.vector = INFINITY;
        const int thin = thin_lanes(place, rays, candidates & ~found.inside & ~found.single, &found, &s, 0, 1, tally);
        hit &= ~thin;
        if (thin) hit |= test_silhouette(place, rays, thin, &found, &s, 1, thin & ~deep, &at, &reach, tally);
#endif
        tally->carved += __builtin_popcount(candidates & ~hit);
        tally->inside += __builtin_popcount(hit & found.inside);
        if (!hit) continue;

        const int solid = hit & ~found.inside;
        float16 d = 0.0f;
#if SILHOUETTE != 0
        int asked = solid & deep & ~to_bits(reach.vector >= 0.0f);
        const Vector3 towards = {-rays->direction.x, -rays->direction.y, -rays->direction.z};
        const Vector3 wo = to_local(&s, towards);
        int fronts = 0;
        for (int rest = asked & found.single; rest; rest &= rest - 1) {
            const int l = __builtin_ctz(rest);
            if (tag_of(place, found.front.lane[l]) & FRONT) fronts |= 1 << l;
        }
        asked = (asked & ~found.single) | fronts;
        d = reach.vector >= 0.0f ? reach.vector : 0.0f;
        while (asked) {
            int object;
            const int same = of_one_object(&found.object, asked, &object);
            __global const Mdf *mdf = place->mdfs + object;
            asked &= ~same;
            if (!mdf->there) continue;
            const int below = same & ~on_plateau(place->tables, mdf, same, s.u, s.v);
            tally->looked += __builtin_popcount(below);
            if (!below) continue;  // d is 0 already
            float16 D = s.scale * mdf_distance(place->tables, mdf, below, s.u, s.v, wo);
            // A ray without a hit ends at the bottom of an open surface's slab.
            const float16 lowest = s.scale * mdf->h / MAX(wo.z, (float16)MIN_COS);
            D = from_bits(found.single) & (D == INFINITY) ? lowest : D;
            d = from_bits(below) ? D : d;
        }
#if SILHOUETTE == 2
        const int16 interval = ~from_bits(found.single) & (reach.vector < 0.0f);
        d = interval & (d > length) ? length : d;
        d = interval & (at.vector < d) ? at.vector : d;
#endif
#endif
#ifdef GDM
        const int16 in_shell = from_bits(entering);
        const float16 deeper = met.t.vector - found.t_front.vector;
        d = in_shell ? MAX(deeper, (float16)0.0f) : d;
#endif
        const float16 depth = found.t_front.vector + d;
        const int16 better = from_bits(hit) & (depth < seen.depth.vector);
        const int bits = to_bits(better);
        // What loses, now or to what was found now, is not shaded.
#ifdef GDM
        if (entering) {
            surface_in_shell(place->shells.prisms, place->records, &met, entering, &s);
            position.x = in_shell ? rays->origin.x + depth * rays->direction.x : position.x;
            position.y = in_shell ? rays->origin.y + depth * rays->direction.y : position.y;
            position.z = in_shell ? rays->origin.z + depth * rays->direction.z : position.z;
        }
        const Seen other = {s, position, found.object, {depth}, hit & ~bits, found.inside & hit & ~bits, met.place.z,
                            entering, entering & met.floor};
#else
        const Seen other = {s, position, found.object, {depth}, hit & ~bits, found.inside & hit & ~bits};
#endif
        const int replaced = seen.seen & bits, beaten = hit & ~bits;
        if (place->skips & SKIP_LOSERS) {
            tally->losers += __builtin_popcount(replaced) + __builtin_popcount(beaten);
        } else {
            Seen loser = seen;
            loser.seen = replaced;
            if (replaced) draw_stamp(place, target, rays, &loser, tally);
            if (beaten) draw_stamp(place, target, rays, &other, tally);
        }
        seen.seen |= bits;
        seen.inside = (seen.inside & ~bits) | (found.inside & bits);
#ifdef GDM
        seen.met = (seen.met & ~bits) | (other.met & bits);
        seen.floor = (seen.floor & ~bits) | (other.floor & bits);
        seen.z = better ? other.z : seen.z;
#endif
        seen.depth.vector = better ? depth : seen.depth.vector;
        seen.object.vector = better ? found.object.vector : seen.object.vector;
        if (first_seen) {
            seen.at = s;
            seen.position = position;
            first_seen = 0;
        } else {
            Floats *to = (Floats *)&seen.at;
            const Floats *from = (const Floats *)&s;
            for (int k = 0; k < (int)(sizeof(Surface) / sizeof(float16)); k++)
                to[k].vector = better ? from[k].vector : to[k].vector;
            seen.position.x = better ? position.x : seen.position.x;
            seen.position.y = better ? position.y : seen.position.y;
            seen.position.z = better ? position.z : seen.position.z;
        }
        // Nothing begins within the interval: what comes later lies behind.
        const int resolved = hit & ~found.crowded & ~found.single;
        if (place->skips & SKIP_BEHIND) active &= ~resolved;
    }
    return seen;
}

// A stamp where nothing is seen.
static void clear_stamp(__global const Frame *frame, const int plane, const int x, const int y, const float4 background,
                        const uchar16 shown_background, __global uchar4 *shown, __global float4 *rgba,
                        __global float *depth, __global int *owner, __global uchar *shadowed)
{
    for (int row = 0; row < 4; row++) {
        const int first = (y + row) * frame->pitch + x;
        if (frame->outputs & DISPLAY) {
            *(__global uchar16 *)(shown + first) = shown_background;
            continue;
        }
        for (int k = 0; k < 4; k++) rgba[first + k] = background;
        if (frame->outputs & OWNER) {
            *(__global float4 *)(depth + first) = INFINITY;
            *(__global int4 *)(owner + first) = -1;
            for (int i = 0; i < frame->lights; i++)
                for (int k = 0; k < 4; k++) shadowed[i * plane + first + k] = 0;
        }
    }
}

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
                             __global uchar *restrict empty SHELL_PARAMETERS)
{
    const Place place = {view, slots, labels, records, facets, tables, mdfs, counters->near_bodies, 1,
                         frame->skips SHELL_PLACE};
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
          SHELL_PARAMETERS)
{
    draw_tiles(get_group_id(0), view, triangles, slots, labels, boxes, coarse, counters, records, facets, tables,
               mdfs, reflectances, lights, light_views, light_slots, light_labels, light_counters, passages, kept_key,
               kept_slot, blockers, frame, key, slot, shown, rgba, depth, owner, shadowed, empty SHELL_ARGUMENTS);
}
