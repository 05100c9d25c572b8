// Projection of splats: a record of 16 numbers for each, which blending reads, and its ellipse.
//
// A record holds the exponent around the axis of the larger variance, to base 2:
//     alpha = opacity exp2(-(A u)^2 - (B t)^2),  u = major - mean,  t = minor - K major - cut,
// major and minor a pixel's coordinates along that axis's direction and the other. Mean and cut are
// kept as a whole number and the rest, K as 11 bits and the rest: what a tile takes from them is
// then exact.
//     0: mean (whole, rest), cut (whole, rest)    1: K (11 bits, rest), A, B
//     2: red, green, blue, opacity                3: depth, whether tall, origin, origin's cut
// The origin is that of the sums of the backward pass: see `cpu.projection.sums_origin`.
//
// A shape is the ellipse outside which alpha is below 1/255: 0: centre, half the size of its box;
// 1: correlation, sqrt(1 - correlation^2), first and last row of tiles.

//include common.wgsl
//include geometry.wgsl

const SQRT_LOG2E = 1.2011224087864498;
const LOG_FAINTEST = -5.541263545158426; // ln(1 / 255)

@group(0) @binding(3) var<storage, read_write> records: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> shapes: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> keys: array<u32>;
@group(0) @binding(6) var<storage, read_write> culled: array<u32>;

// See `reference.drawable`.
fn drawable(at: u32, i: u32) -> bool {
    var good = true;
    for (var k = 0u; k < view.used; k++) {
        good = good && is_finite(rows[at + k]);
    }
    good = good && all(triple(at + LOG_SCALE) <= vec3(LOG_SCALE_MAX));
    var longest = 0.0;
    for (var k = 0u; k < 4; k++) {
        longest = max(longest, abs(rows[at + ROTATION + k]));
    }
    good = good && longest >= QUATERNION_MIN;
    if (view.smoothed != 0) {
        let width = smoothing[i];
        good = good && is_finite(width) && width >= 0 && width <= SCALE_MAX;
    }
    return good;
}

fn colour(at: u32) -> vec3<f32> {
    let values = basis(direction(at).xyz);
    var found = vec3(0.5);
    for (var k = 0u; k < COEFFICIENTS; k++) {
        found += values[k] * triple(at + SH + 3 * k);
    }
    return clamp(found, vec3(0.0), vec3(COLOUR_MAX));
}

// Whole pixels near a mean in the picture; else where the offsets are least in the picture.
fn sums_origin(major: f32, minor: f32, k: f32, own_cut: f32, across: f32, down: f32) -> vec2<f32> {
    let origin = clamp(floor(major + 0.5), 0.0, across);
    let inside = major >= 0 && major <= across && minor >= 0 && minor <= down;
    let far = select(0.0, across, k > 0);
    var cut = own_cut;
    if (!inside && -minor - k * (far - major) > 0) {
        cut = -k * far;
    } else if (!inside && down - minor - k * (across - far - major) < 0) {
        cut = down - k * (across - far);
    }
    return vec2(origin, cut);
}

fn put_record(i: u32, f: Footprint, shown: vec3<f32>) {
    let tall = f.c > f.a;
    let larger = max(f.a, f.c);
    let k = f.b / larger;
    let size = view.cam[6].zw;
    let place = select(f.mean.xy, f.mean.yx, tall);
    let extent = select(size.xy, size.yx, tall);
    let cut = place.y - k * place.x;
    let whole = floor(vec2(place.x, cut) + 0.5);
    let slope = floor(k * 2048 + 0.5) / 2048;
    let origin = sums_origin(place.x, place.y, k, whole.y, extent.x, extent.y);
    let root_a = sqrt(0.5 / larger) / f.size * SQRT_LOG2E;
    let root_b = sqrt(0.5 * larger) / f.root / f.size * SQRT_LOG2E;
    records[4 * i] = vec4(whole.x, place.x - whole.x, whole.y, cut - whole.y);
    records[4 * i + 1] = vec4(slope, k - slope, root_a, root_b);
    records[4 * i + 2] = vec4(shown, f.opacity);
    records[4 * i + 3] = vec4(f.at.z, select(0.0, 1.0, tall), origin);
}

// Whether the splat touches the picture; its shape if so.
fn put_shape(i: u32, f: Footprint) -> bool {
    let size = view.cam[6].zw;
    let reach = max(0.0, 2 * (log(f.opacity) - LOG_FAINTEST));
    let box = min(sqrt(reach * vec2(f.a, f.c)) * f.size, vec2(1e37));
    if (any(f.mean + box < vec2(0.5)) || any(f.mean - box > size - 0.5)) {
        return false;
    }
    let slack = 1e-3 + 1e-5 * box.y + 1e-6 * abs(f.mean.y);
    let ends = vec2(f.mean.y - box.y - slack, f.mean.y + box.y + slack) - 0.5;
    let tiles = floor(clamp(ends, vec2(0.0), vec2(size.y - 1)) / f32(view.tile));
    let rho = f.b / sqrt(f.a) / sqrt(f.c);
    shapes[2 * i] = vec4(f.mean, box);
    shapes[2 * i + 1] = vec4(rho, f.root / sqrt(f.a) / sqrt(f.c), tiles);
    return true;
}

// Record, shape and key (the bits of the depth, NOWHERE where not visible) of each row, and whether
// it has values that cannot be drawn.
@compute @workgroup_size(64)
fn project(here: Place) {
    let i = number_of(here);
    if (i >= view.n) {
        return;
    }
    let at = i * view.columns;
    keys[i] = NOWHERE;
    let good = drawable(at, i);
    culled[i] = select(1u, 0u, good);
    if (!good || !(position(at).z > view.cam[5].x)) {
        return;
    }
    let f = footprint(at, i);
    if (!is_finite(f.size) || !(f.root > 0) || !(f.opacity >= ALPHA_MIN)) {
        return;
    }
    if (put_shape(i, f)) {
        put_record(i, f, colour(at));
        keys[i] = bitcast<u32>(f.at.z);
    }
}
