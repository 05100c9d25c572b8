// The loss and its gradient: definitions as in `loss_kernels`, the target as in `train.views`.
//
// A group of `similarity` and `loss_gradient` is a square of 16 x 16 pixels of one channel. It reads
// what the windows of these pixels reach, filters it along rows, then across them. `parts` takes the
// sum over each group, and `sum_rows` adds these up in a fixed order.
//include common.wgsl

struct Compared {
    width: u32, height: u32, across: u32, down: u32,
    transparent: u32, ignores: u32, bright: f32, weight: f32,
    background: vec4f, gains: vec4f, offsets: vec4f,
}
struct Rows { count: u32, factor: f32, first: u32 }
const SIDE = 16u + 2u * RADIUS; // of a square and what its windows reach
const AREA = SIDE * SIDE;
const BAND = SIDE * 16u;
const WINDOW = array<f32, 11>(
    TAP_0, TAP_1, TAP_2, TAP_3, TAP_4, TAP_5, TAP_4, TAP_3, TAP_2, TAP_1, TAP_0,
);
@group(0) @binding(0) var<uniform> p: Compared;
@group(0) @binding(1) var<storage, read> photograph: array<u32>; // red, green, blue, mask: a byte each
@group(0) @binding(2) var<storage, read> image: array<f32>;
@group(0) @binding(3) var<storage, read> wanted: array<f32>;
@group(0) @binding(4) var<storage, read> means: array<f32>;
@group(0) @binding(5) var<storage, read> slopes: array<f32>;
@group(0) @binding(6) var<storage, read_write> out: array<f32>;
@group(0) @binding(7) var<storage, read_write> parts: array<f32>;
@group(0) @binding(0) var<uniform> rows: Rows;
@group(0) @binding(1) var<storage, read> addends: array<f32>;
@group(0) @binding(2) var<storage, read_write> sums: array<f32>;
var<workgroup> shared_sums: array<f32, 256>;
var<workgroup> near: array<vec2f, AREA>; // picture less the target's mean, picture less target
var<workgroup> maps: array<vec4f, BAND>; // means of both, both variances added, the difference's
var<workgroup> around: array<array<f32, AREA>, 3>;
var<workgroup> filtered: array<array<f32, BAND>, 3>;

// The sum of `value` over a group of 256, in a fixed order, for lane 0.
fn group_sum(value: f32, lane: u32) -> f32 {
    workgroupBarrier();
    shared_sums[lane] = value;
    for (var half = 128u; half > 0u; half /= 2u) {
        workgroupBarrier();
        if (lane < half) { shared_sums[lane] += shared_sums[lane + half]; }
    }
    return shared_sums[0];
}

// Column and row of a group's square, and its channel.
fn square(number: u32) -> vec3u {
    return vec3u(number % p.across, number / p.across % p.down, number / (p.across * p.down));
}

// Where pixel k of a square and its surroundings lies in the planes; -1 outside the picture.
fn place(here: vec3u, k: u32) -> i32 {
    let at = vec2i(here.xy * 16u + vec2u(k % SIDE, k / SIDE)) - i32(RADIUS);
    let size = vec2i(vec2u(p.width, p.height));
    let inside = all(at >= vec2i()) && all(at < size) && here.z < 3u;
    return select(-1, (i32(here.z) * size.y + at.y) * size.x + at.x, inside);
}

// out [3, H, W]: the target of the picture. parts [3, groups]: its sums.
@compute @workgroup_size(256)
fn target_of(at_work: Place) {
    let lane = at_work.lane;
    let number = group_of(at_work);
    let pixels = p.width * p.height;
    let at = number * 256u + lane;
    let inside = at < pixels;
    let texel = unpack4x8unorm(photograph[min(at, pixels - 1u)]);
    let solid = select(1.0, texel.w, p.transparent != 0u);
    for (var k = 0u; k < 3u; k++) {
        let drawn = image[k * pixels + min(at, pixels - 1u)];
        var value = (texel[k] - p.offsets[k] * solid) / p.gains[k];
        if (texel[k] >= p.bright) { value = max(value, drawn); }
        value += (1.0 - solid) * p.background[k];
        if (p.ignores != 0u && texel.w == 0.0) { value = drawn; }
        if (inside) { out[k * pixels + at] = value; }
        let sum = group_sum(select(0.0, value, inside), lane);
        if (lane == 0u && inside) { parts[k * ((pixels + 255u) / 256u) + number] = sum; }
    }
}

// sums[first + k] = factor x the sum of row k of `addends` [rows, count]. One group a row.
@compute @workgroup_size(256)
fn sum_rows(at_work: Place) {
    let lane = at_work.lane;
    let row = group_of(at_work);
    var total = 0.0;
    for (var k = lane; k < rows.count; k += 256u) { total += addends[row * rows.count + k]; }
    let sum = group_sum(total, lane);
    if (lane == 0u) { sums[rows.first + row] = rows.factor * sum; }
}

// slopes [3, 3, H, W] into `out`: see `loss_kernels._similarity_row`. parts: sums of SSIM.
@compute @workgroup_size(256)
fn similarity(at_work: Place) {
    let lane = at_work.lane;
    let number = group_of(at_work);
    let here = square(number);
    let mean = means[min(here.z, 2u)];
    for (var k = lane; k < AREA; k += 256u) {
        let at = place(here, k);
        near[k] = vec2f();
        if (at >= 0) { near[k] = image[at] - vec2f(mean, wanted[at]); }
    }
    workgroupBarrier();
    for (var k = lane; k < BAND; k += 256u) {
        let first = k / 16u * SIDE + k % 16u;
        let own = near[first + RADIUS];
        var found = vec4f();
        for (var tap = 0u; tap < 2u * RADIUS + 1u; tap++) {
            let off = near[first + tap] - own;
            let y = off.x - off.y;
            found += WINDOW[tap] * vec4f(off, off.x * off.x + y * y, off.y * off.y);
        }
        let m_y = found.x - found.y;
        let squares = vec2f(found.x * found.x + m_y * m_y, found.y * found.y);
        maps[k] = vec4f(own + found.xy, found.zw - squares);
    }
    workgroupBarrier();
    let own = maps[lane + 16u * RADIUS].xy;
    var found = vec4f();
    for (var tap = 0u; tap < 2u * RADIUS + 1u; tap++) {
        let row = maps[lane + 16u * tap];
        let off = row.xy - own;
        let y = off.x - off.y;
        found += WINDOW[tap] * vec4f(off, off.x * off.x + y * y + row.z, off.y * off.y + row.w);
    }
    let m_y = found.x - found.y;
    let both = found.z - found.x * found.x - m_y * m_y;
    let other = found.w - found.y * found.y;
    let m_x = own.x + found.x;
    let m_d = own.y + found.y;
    let full_x = m_x + mean;
    let c = 2.0 * full_x * (full_x - m_d) + C1;
    let a = m_d * m_d + c;
    let b = both + C2;
    let d = b - other;
    let inverse = 1.0 / (a * b);
    let by_cov = 2.0 * c * inverse;
    let by_both = by_cov * other * a * inverse;
    let by_mean = 2.0 * d * inverse * m_d * (full_x * m_d * b * inverse - 1.0);
    let at = place(here, (lane / 16u + RADIUS) * SIDE + lane % 16u + RADIUS);
    if (at >= 0) {
        let plane = 3u * p.width * p.height;
        out[u32(at)] = by_mean - m_x * by_both + m_d * by_cov;
        out[plane + u32(at)] = by_both;
        out[2u * plane + u32(at)] = by_cov;
    }
    let sum = group_sum(select(0.0, c * d * inverse, at >= 0), lane);
    if (lane == 0u && here.z < 3u) { parts[number] = sum; }
}

// v_image [3, H, W] into `out`: weight x the gradient of H x W x loss, 0 where the mask ignores.
// parts: sums of |picture - target|.
@compute @workgroup_size(256)
fn loss_gradient(at_work: Place) {
    let lane = at_work.lane;
    let number = group_of(at_work);
    let here = square(number);
    let area = p.width * p.height;
    for (var k = lane; k < AREA; k += 256u) {
        let at = place(here, k);
        for (var which = 0u; which < 3u; which++) {
            around[which][k] = 0.0;
            if (at >= 0) { around[which][k] = slopes[which * 3u * area + u32(at)]; }
        }
    }
    workgroupBarrier();
    for (var k = lane; k < BAND; k += 256u) {
        let first = k / 16u * SIDE + k % 16u;
        for (var which = 0u; which < 3u; which++) {
            var total = 0.0;
            for (var tap = 0u; tap < 2u * RADIUS + 1u; tap++) {
                total += WINDOW[tap] * around[which][first + tap];
            }
            filtered[which][k] = total;
        }
    }
    workgroupBarrier();
    var found = vec3f();
    for (var tap = 0u; tap < 2u * RADIUS + 1u; tap++) {
        let at = lane + 16u * tap;
        found += WINDOW[tap] * vec3f(filtered[0][at], filtered[1][at], filtered[2][at]);
    }
    let at = place(here, (lane / 16u + RADIUS) * SIDE + lane % 16u + RADIUS);
    var apart = 0.0;
    if (at >= 0) {
        let d = image[at] - wanted[at];
        let similar = found.x + (image[at] - means[here.z]) * found.y - d * found.z;
        let gradient = ((1.0 - SSIM_WEIGHT) * sign(d) - SSIM_WEIGHT * similar) / 3.0;
        let ignored = p.ignores != 0u && photograph[u32(at) % area] >> 24u == 0u;
        out[at] = select(p.weight * gradient, 0.0, ignored);
        apart = abs(d);
    }
    let sum = group_sum(apart, lane);
    if (lane == 0u && here.z < 3u) { parts[number] = sum; }
}
