// Blending of a tile's splats from near to far, and its backward pass from far to near.
//
// A tile of 16 x 16 pixels is a workgroup of 64 lanes. A lane has four pixels below each other: a
// number for each of the four is a vec4. A splat's gradient is summed over the tile and written to a
// slot of its own, so that sums have a fixed order. Both passes use `alphas`, because the backward
// pass divides by 1 - alpha.

//include common.wgsl

const LANES = 64u;
const TILE = 16u;
const NEVER = 0x40000000u; // the last entry drawn in a pixel that was not finished
const SUMS = 9u; // of the backward pass: by u, t, u u, t t, u t, 1, and by red, green, blue
const BATCH = 7u; // splats that are summed together: 63 sums, one for each lane but one

struct Picture {
    width: u32,
    height: u32,
    tiles_x: u32,
    tiles: u32,
    red: f32,
    green: f32,
    blue: f32,
    depths: u32,
    largest: u32, // column of which not the sum, but the largest is taken; SUMS for none
}

@group(0) @binding(0) var<uniform> picture: Picture;
@group(0) @binding(1) var<storage, read> records: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> members: array<u32>;
@group(0) @binding(3) var<storage, read> starts: array<u32>;

// A tile's pixels of a lane: the first pixel of the tile, offsets from it, places in a plane.
struct Pixels {
    corner: vec2<f32>,
    i: f32,
    j: vec4<f32>,
    at: vec4<u32>,
    within: vec4<bool>,
}

fn pixels_of(tile: u32, lane: u32) -> Pixels {
    let corner = vec2(tile % picture.tiles_x, tile / picture.tiles_x) * TILE;
    let i = lane % TILE;
    let j = lane / TILE + vec4(0u, 4u, 8u, 12u);
    let x = corner.x + i;
    let y = corner.y + j;
    return Pixels(
        vec2<f32>(corner) + 0.5, f32(i), vec4<f32>(j), y * picture.width + x,
        (y < vec4(picture.height)) & vec4(x < picture.width),
    );
}

// What lies in a tile of a splat: u and t of its first pixel; what a step along x and along y adds.
struct Frame {
    u: f32,
    t: f32,
    by_u: vec2<f32>,
    by_t: vec2<f32>,
}

// Coordinates in the picture have 13 bits and the first part of K has 11: their product is exact.
fn frame_of(row: u32, corner: vec2<f32>) -> Frame {
    let at = records[4 * row];
    let slope = records[4 * row + 1].xy;
    let tall = records[4 * row + 3].y != 0;
    let place = select(corner.xy, corner.yx, tall);
    let u = (place.x - at.x) - at.y;
    let t = ((place.y - at.z) - slope.x * place.x) - (slope.y * place.x + at.w);
    let by_u = select(vec2(1.0, 0.0), vec2(0.0, 1.0), tall);
    let by_t = vec2(-slope.x - slope.y, 1.0);
    return Frame(u, t, by_u, select(by_t.xy, by_t.yx, tall));
}

// Alphas before the cap.
fn alphas(row: u32, f: Frame, p: Pixels) -> vec4<f32> {
    let a = records[4 * row + 1].z;
    let b = records[4 * row + 1].w;
    let along = fma(vec4(a * f.by_u.y), p.j, vec4(fma(a * f.by_u.x, p.i, a * f.u)));
    let across = fma(vec4(b * f.by_t.y), p.j, vec4(fma(b * f.by_t.x, p.i, b * f.t)));
    return records[4 * row + 2].w * exp2(-min(fma(along, along, across * across), vec4(200.0)));
}

@group(0) @binding(4) var<storage, read_write> image: array<f32>;
@group(0) @binding(5) var<storage, read_write> transmittance: array<f32>;
@group(0) @binding(6) var<storage, read_write> last: array<u32>;

// image [4 or 6, H, W]: colour, alpha, and with `depths` expected and median depth. transmittance
// [H, W]: what is left. last [H, W]: the number of the last entry drawn, or NEVER.
@compute @workgroup_size(LANES)
fn blend(here: Place) {
    let lane = here.lane;
    let tile = group_of(here);
    if (tile >= picture.tiles) {
        return;
    }
    let p = pixels_of(tile, lane);
    let none = vec4(0.0);
    var passing = select(none, vec4(1.0), p.within);
    var finished_at = vec4(NEVER);
    var colour = array(none, none, none);
    var depth = none;
    var median = none;
    let start = starts[tile];
    let end = starts[tile + 1];
    for (var entry = start; entry < end; entry++) {
        let row = members[entry];
        let raw = alphas(row, frame_of(row, p.corner), p);
        let drawn = (raw >= vec4(ALPHA_MIN)) & (passing >= vec4(TRANSMITTANCE_MIN));
        let alpha = select(none, min(raw, vec4(ALPHA_MAX)), drawn);
        let weight = alpha * passing;
        let left = passing * (1 - alpha);
        let shown = records[4 * row + 2];
        colour[0] = fma(weight, vec4(shown.x), colour[0]);
        colour[1] = fma(weight, vec4(shown.y), colour[1]);
        colour[2] = fma(weight, vec4(shown.z), colour[2]);
        let z = vec4(records[4 * row + 3].x);
        depth = fma(weight, z, depth);
        median = select(median, z, (passing >= vec4(0.5)) & (left < vec4(0.5)));
        let ends = drawn & (left < vec4(TRANSMITTANCE_MIN));
        finished_at = select(finished_at, vec4(entry - start + 1), ends);
        passing = left;
        if (all(passing < vec4(TRANSMITTANCE_MIN))) {
            break;
        }
    }
    let size = picture.width * picture.height;
    let background = vec3(picture.red, picture.green, picture.blue);
    for (var k = 0u; k < 4; k++) {
        if (!p.within[k]) {
            continue;
        }
        let at = p.at[k];
        for (var c = 0u; c < 3; c++) {
            image[c * size + at] = fma(passing[k], background[c], colour[c][k]);
        }
        image[3 * size + at] = 1 - passing[k];
        if (picture.depths != 0) {
            let mean = depth[k] / max(1 - passing[k], 0.5 * ALPHA_MIN);
            image[4 * size + at] = min(mean, 3.4e38);
            image[5 * size + at] = median[k];
        }
        transmittance[at] = passing[k];
        last[at] = finished_at[k];
    }
}

@group(0) @binding(4) var<storage, read> slots: array<u32>;
@group(0) @binding(5) var<storage, read> left_over: array<f32>; // transmittance
@group(0) @binding(6) var<storage, read> finished: array<u32>; // last
@group(0) @binding(7) var<storage, read> planes: array<f32>; // [3, H, W]
@group(0) @binding(8) var<storage, read_write> out: array<f32>; // [capacity, SUMS]
var<workgroup> parts: array<f32, 4032>; // [BATCH, SUMS, LANES]
var<workgroup> furthest: atomic<u32>;

// A lane on its way from far to near: the entries from the tile's first that are left, and what
// reaches the last of them.
struct Walk {
    p: Pixels,
    finished_at: vec4<u32>,
    start: u32,
    left: u32,
    passing: vec4<f32>,
}

fn walk_of(tile: u32, lane: u32) -> Walk {
    let p = pixels_of(tile, lane);
    let ends = vec4(finished[p.at.x], finished[p.at.y], finished[p.at.z], finished[p.at.w]);
    let finished_at = select(vec4(0u), ends, p.within);
    let most = max(max(finished_at.x, finished_at.y), max(finished_at.z, finished_at.w));
    if (lane == 0) {
        atomicStore(&furthest, 0u); // not every implementation begins with zeros
    }
    workgroupBarrier();
    atomicMax(&furthest, most);
    workgroupBarrier();
    let left = min(atomicLoad(&furthest), starts[tile + 1] - starts[tile]);
    let over = vec4(left_over[p.at.x], left_over[p.at.y], left_over[p.at.z], left_over[p.at.w]);
    return Walk(p, finished_at, starts[tile], left, select(vec4(0.0), over, p.within));
}

// The splat of the last entry that is left.
struct Layer {
    row: u32,
    frame: Frame,
    raw: vec4<f32>, // alpha before the cap
    alpha: vec4<f32>,
    inverse: vec4<f32>, // 1 / (1 - alpha)
    weight: vec4<f32>,
    colour: vec3<f32>,
}

fn next_layer(w: ptr<function, Walk>) -> Layer {
    let row = members[(*w).start + (*w).left - 1];
    let frame = frame_of(row, (*w).p.corner);
    let raw = alphas(row, frame, (*w).p);
    let drawn = (raw >= vec4(ALPHA_MIN)) & ((*w).finished_at >= vec4((*w).left));
    let alpha = select(vec4(0.0), min(raw, vec4(ALPHA_MAX)), drawn);
    let inverse = 1 / (1 - alpha);
    (*w).passing *= inverse;
    (*w).left -= 1;
    let colour = records[4 * row + 2].xyz;
    return Layer(row, frame, raw, alpha, inverse, alpha * (*w).passing, colour);
}

fn plane(channel: u32, p: Pixels) -> vec4<f32> {
    let at = p.at + channel * picture.width * picture.height;
    let values = vec4(planes[at.x], planes[at.y], planes[at.z], planes[at.w]);
    return select(vec4(0.0), values, p.within);
}

fn put(k: u32, column: u32, lane: u32, values: vec4<f32>) {
    let top = max(max(values.x, values.y), max(values.z, values.w));
    let sum = (values.x + values.y) + (values.z + values.w);
    parts[(k * SUMS + column) * LANES + lane] = select(sum, top, column == picture.largest);
}

// Each lane begins with another, so that they do not wait for the same bank of memory.
fn part(lane: u32, i: u32) -> f32 {
    return parts[lane * LANES + i % LANES];
}

// Adds up what the lanes have put, and writes it to the slots of the `count` entries that follow
// the walk, last first.
fn write_sums(w: Walk, count: u32, lane: u32) {
    workgroupBarrier();
    let k = lane / SUMS;
    let column = lane % SUMS;
    if (k < count) {
        var four = vec4(0.0);
        for (var i = lane; i < lane + LANES; i += 4) {
            let next = vec4(part(lane, i), part(lane, i + 1), part(lane, i + 2), part(lane, i + 3));
            four = select(four + next, max(four, next), column == picture.largest);
        }
        let sum = (four.x + four.y) + (four.z + four.w);
        let top = max(max(four.x, four.y), max(four.z, four.w));
        let slot = slots[w.start + w.left + count - 1 - k];
        out[slot * SUMS + column] = select(sum, top, column == picture.largest);
    }
    workgroupBarrier();
}

// out at each entry's slot, zero before: gradients of the splat's exponent and colour, planes being
// the gradient of the image.
@compute @workgroup_size(LANES)
fn gradient(here: Place) {
    let lane = here.lane;
    let tile = group_of(here);
    if (tile >= picture.tiles) {
        return;
    }
    var w = walk_of(tile, lane);
    let p = w.p;
    let v_r = plane(0, p);
    let v_g = plane(1, p);
    let v_b = plane(2, p);
    var behind = (v_r * picture.red + v_g * picture.green + v_b * picture.blue) * w.passing;
    while (w.left > 0) {
        let together = min(BATCH, w.left);
        for (var k = 0u; k < together; k++) {
            let one = next_layer(&w);
            let shade = v_r * one.colour.x + v_g * one.colour.y + v_b * one.colour.z;
            let by_exponent = one.alpha * (behind * one.inverse - w.passing * shade);
            behind = fma(one.weight, shade, behind);
            // no gradient where alpha is capped
            let v = select(vec4(0.0), by_exponent, one.raw < vec4(ALPHA_MAX));
            let f = one.frame;
            let origin = records[4 * one.row + 3].zw;
            let slope = records[4 * one.row + 1].xy;
            let place = select(p.corner.xy, p.corner.yx, f.by_u.y != 0);
            let first_t = ((place.y - origin.y) - slope.x * place.x) - slope.y * place.x;
            let u = fma(p.j, vec4(f.by_u.y), vec4(fma(p.i, f.by_u.x, place.x - origin.x)));
            let t = fma(p.j, vec4(f.by_t.y), vec4(fma(p.i, f.by_t.x, first_t)));
            put(k, 0, lane, v * u);
            put(k, 1, lane, v * t);
            put(k, 2, lane, v * u * u);
            put(k, 3, lane, v * t * t);
            put(k, 4, lane, v * u * t);
            put(k, 5, lane, v);
            put(k, 6, lane, one.weight * v_r);
            put(k, 7, lane, one.weight * v_g);
            put(k, 8, lane, one.weight * v_b);
        }
        write_sums(w, together, lane);
    }
}

// out at each entry's slot, zero before: columns as in `definition.CONTRIBUTIONS`, planes being
// render - photograph. See `cpu.contributions`.
@compute @workgroup_size(LANES)
fn contributions(here: Place) {
    let lane = here.lane;
    let tile = group_of(here);
    if (tile >= picture.tiles) {
        return;
    }
    var w = walk_of(tile, lane);
    let errors = array(plane(0, w.p), plane(1, w.p), plane(2, w.p));
    var behind = array(w.passing * picture.red, w.passing * picture.green, w.passing * picture.blue);
    while (w.left > 0) {
        let together = min(BATCH, w.left);
        for (var k = 0u; k < together; k++) {
            let one = next_layer(&w);
            var change = vec4(0.0);
            var square = vec4(0.0);
            for (var c = 0u; c < 3; c++) {
                let painted = one.weight * one.colour[c];
                let shift = behind[c] * (one.alpha * one.inverse) - painted;
                change += shift * (shift + 2 * errors[c]);
                square += shift * shift;
                behind[c] += painted;
                put(k, 5 + c, lane, one.weight * errors[c]);
            }
            put(k, 0, lane, change);
            put(k, 1, lane, square);
            put(k, 2, lane, one.weight);
            put(k, 3, lane, one.weight); // of which the largest is taken
            put(k, 4, lane, one.weight * one.weight);
            put(k, 8, lane, vec4(0.0));
        }
        write_sums(w, together, lane);
    }
}
