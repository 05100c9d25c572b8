// Blending of a tile's splats from near to far, and its backward pass from far to near.
//
// A tile of 16 x 16 pixels is a workgroup of 64 lanes with four pixels each, below each other: a number for each of the four is a vec4. A splat's gradient is summed over the
// tile and written to a slot of its own, so that sums have a fixed order. Both passes use `alphas`,
// because the backward pass divides by 1 - alpha.

//include common.wgsl

const LANES = 64u;
const TILE = 16u;
const NEVER = 0x40000000u; // the last entry drawn in a pixel that was not finished
const SUMS = 9u; // of the backward pass: by u, t, u u, t t, u t, 1, and by red, green, blue
const BATCH = 7u; // splats that are summed together: 63 sums, one for each lane but one
const LARGEST_WEIGHT = 3u; // column of the contributions of which the largest is taken

struct Picture {
    width: u32,
    height: u32,
    tiles_x: u32,
    tiles: u32,
    red: f32,
    green: f32,
    blue: f32,
    depths: u32,
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
    u_x: f32,
    u_y: f32,
    t_x: f32,
    t_y: f32,
}

// Coordinates in the picture have 13 bits and the first part of K has 11: their product is exact.
fn frame_of(row: u32, corner: vec2<f32>) -> Frame {
    let at = records[4 * row];
    let slope = records[4 * row + 1].xy;
    let tall = records[4 * row + 3].y;
    let major = select(corner.x, corner.y, tall != 0);
    let minor = select(corner.y, corner.x, tall != 0);
    let u = (major - at.x) - at.y;
    let t = ((minor - at.z) - slope.x * major) - (slope.y * major + at.w);
    let k = slope.x + slope.y;
    return Frame(u, t, 1 - tall, tall, select(-k, 1.0, tall != 0), select(1.0, -k, tall != 0));
}

// Alphas before the cap.
fn alphas(row: u32, f: Frame, p: Pixels) -> vec4<f32> {
    let a = records[4 * row + 1].z;
    let b = records[4 * row + 1].w;
    let along = fma(vec4(a * f.u_y), p.j, vec4(fma(a * f.u_x, p.i, a * f.u)));
    let across = fma(vec4(b * f.t_y), p.j, vec4(fma(b * f.t_x, p.i, b * f.t)));
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
        finished_at = select(finished_at, vec4(entry - start + 1), drawn & (left < vec4(TRANSMITTANCE_MIN)));
        passing = left;
        if (all(passing < vec4(TRANSMITTANCE_MIN))) {
            break;
        }
    }
    let plane = picture.width * picture.height;
    let background = vec3(picture.red, picture.green, picture.blue);
    for (var k = 0u; k < 4; k++) {
        if (!p.within[k]) {
            continue;
        }
        let at = p.at[k];
        for (var c = 0u; c < 3; c++) {
            image[c * plane + at] = fma(passing[k], background[c], colour[c][k]);
        }
        image[3 * plane + at] = 1 - passing[k];
        if (picture.depths != 0) {
            image[4 * plane + at] = depth[k] / max(1 - passing[k], 0.5 * ALPHA_MIN);
            image[5 * plane + at] = median[k];
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

fn put(k: u32, column: u32, lane: u32, value: f32) {
    parts[(k * SUMS + column) * LANES + lane] = value;
}

fn put_sum(k: u32, column: u32, lane: u32, values: vec4<f32>) {
    put(k, column, lane, (values.x + values.y) + (values.z + values.w));
}

// Each lane begins with another, so that they do not wait for the same bank of memory.
fn part(lane: u32, i: u32) -> f32 {
    return parts[lane * LANES + i % LANES];
}

// Adds up what the lanes have put, or takes the largest in column `largest`, and writes it to the
// slots of the `count` entries that end with number `end`, last first.
fn write_sums(start: u32, end: u32, count: u32, lane: u32, largest: u32) {
    workgroupBarrier();
    let k = lane / SUMS;
    let column = lane % SUMS;
    if (k < count) {
        var four = vec4(0.0);
        for (var i = lane; i < lane + LANES; i += 4) {
            let next = vec4(part(lane, i), part(lane, i + 1), part(lane, i + 2), part(lane, i + 3));
            four = select(four + next, max(four, next), column == largest);
        }
        let sum = (four.x + four.y) + (four.z + four.w);
        let top = max(max(four.x, four.y), max(four.z, four.w));
        out[slots[start + end - 1 - k] * SUMS + column] = select(sum, top, column == largest);
    }
    workgroupBarrier();
}

// The number of the tile's entries that reach any pixel, the same for all lanes.
fn reached(tile: u32, lane: u32, finished_at: vec4<u32>) -> u32 {
    let most = max(max(finished_at.x, finished_at.y), max(finished_at.z, finished_at.w));
    if (lane == 0) {
        atomicStore(&furthest, 0u); // not every implementation begins with zeros
    }
    workgroupBarrier();
    atomicMax(&furthest, most);
    workgroupBarrier();
    return min(atomicLoad(&furthest), starts[tile + 1] - starts[tile]);
}

fn plane_of(channel: u32, p: Pixels) -> vec4<f32> {
    let first = channel * picture.width * picture.height;
    var found = vec4(0.0);
    for (var k = 0u; k < 4; k++) {
        if (p.within[k]) {
            found[k] = planes[first + p.at[k]];
        }
    }
    return found;
}

struct Pass {
    passing: vec4<f32>,
    finished_at: vec4<u32>,
}

fn pass_of(p: Pixels) -> Pass {
    var found = Pass(vec4(0.0), vec4(0u));
    for (var k = 0u; k < 4; k++) {
        if (p.within[k]) {
            found.passing[k] = left_over[p.at[k]];
            found.finished_at[k] = finished[p.at[k]];
        }
    }
    return found;
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
    let p = pixels_of(tile, lane);
    let v_r = plane_of(0, p);
    let v_g = plane_of(1, p);
    let v_b = plane_of(2, p);
    let begun = pass_of(p);
    var passing = begun.passing;
    var behind = (v_r * picture.red + v_g * picture.green + v_b * picture.blue) * passing;
    let start = starts[tile];
    let count = reached(tile, lane, begun.finished_at);
    for (var done = 0u; done < count; done += BATCH) {
        let together = min(BATCH, count - done);
        for (var k = 0u; k < together; k++) {
            let number = count - done - k;
            let row = members[start + number - 1];
            let f = frame_of(row, p.corner);
            let raw = alphas(row, f, p);
            let drawn = (raw >= vec4(ALPHA_MIN)) & (begun.finished_at >= vec4(number));
            let alpha = select(vec4(0.0), min(raw, vec4(ALPHA_MAX)), drawn);
            let inverse = 1 / (1 - alpha);
            passing *= inverse;
            let weight = alpha * passing;
            let shown = records[4 * row + 2];
            let shade = v_r * shown.x + v_g * shown.y + v_b * shown.z;
            let by_exponent = alpha * (behind * inverse - passing * shade);
            behind = fma(weight, shade, behind);
            // no gradient where alpha is capped
            let v = select(vec4(0.0), by_exponent, raw < vec4(ALPHA_MAX));
            let origin = records[4 * row + 3].zw;
            let slope = records[4 * row + 1].xy;
            let tall = f.u_y != 0;
            let major = select(p.corner.x, p.corner.y, tall);
            let minor = select(p.corner.y, p.corner.x, tall);
            let first_t = ((minor - origin.y) - slope.x * major) - slope.y * major;
            let u = fma(p.j, vec4(f.u_y), vec4(fma(p.i, f.u_x, major - origin.x)));
            let t = fma(p.j, vec4(f.t_y), vec4(fma(p.i, f.t_x, first_t)));
            put_sum(k, 0, lane, v * u);
            put_sum(k, 1, lane, v * t);
            put_sum(k, 2, lane, v * u * u);
            put_sum(k, 3, lane, v * t * t);
            put_sum(k, 4, lane, v * u * t);
            put_sum(k, 5, lane, v);
            put_sum(k, 6, lane, weight * v_r);
            put_sum(k, 7, lane, weight * v_g);
            put_sum(k, 8, lane, weight * v_b);
        }
        write_sums(start, count - done, together, lane, SUMS);
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
    let p = pixels_of(tile, lane);
    let errors = array(plane_of(0, p), plane_of(1, p), plane_of(2, p));
    let background = vec3(picture.red, picture.green, picture.blue);
    let begun = pass_of(p);
    var passing = begun.passing;
    var behind = array(passing * background.x, passing * background.y, passing * background.z);
    let start = starts[tile];
    let count = reached(tile, lane, begun.finished_at);
    for (var done = 0u; done < count; done += BATCH) {
        let together = min(BATCH, count - done);
        for (var k = 0u; k < together; k++) {
            let number = count - done - k;
            let row = members[start + number - 1];
            let raw = alphas(row, frame_of(row, p.corner), p);
            let drawn = (raw >= vec4(ALPHA_MIN)) & (begun.finished_at >= vec4(number));
            let alpha = select(vec4(0.0), min(raw, vec4(ALPHA_MAX)), drawn);
            let inverse = 1 / (1 - alpha);
            passing *= inverse;
            let weight = alpha * passing;
            let shown = records[4 * row + 2];
            var change = vec4(0.0);
            var square = vec4(0.0);
            for (var c = 0u; c < 3; c++) {
                let painted = weight * shown[c];
                let shift = behind[c] * (alpha * inverse) - painted;
                change += shift * (shift + 2 * errors[c]);
                square += shift * shift;
                behind[c] += painted;
                put_sum(k, 5 + c, lane, weight * errors[c]);
            }
            put_sum(k, 0, lane, change);
            put_sum(k, 1, lane, square);
            put_sum(k, 2, lane, weight);
            put(k, LARGEST_WEIGHT, lane, max(max(weight.x, weight.y), max(weight.z, weight.w)));
            put_sum(k, 4, lane, weight * weight);
            put(k, 8, lane, 0);
        }
        write_sums(start, count - done, together, lane, LARGEST_WEIGHT);
    }
}
