// The optimiser, dropout and the rows of a model: definitions as in `optimiser` and `dropout`.
//include common.wgsl

struct Step {
    n: u32, columns: u32, used: u32, groups: u32, room: u32, extent: f32, ndc_x: f32, ndc_y: f32,
    means: f32, rotation: f32, scale: f32, opacity: f32, dc: f32, rest: f32, damping: f32,
}
@group(0) @binding(0) var<uniform> p: Step;
@group(0) @binding(1) var<storage, read> gradients: array<f32>;
@group(0) @binding(2) var<storage, read> means2d: array<f32>;
@group(0) @binding(3) var<storage, read> keys: array<u32>;
@group(0) @binding(4) var<storage, read> ends: array<u32>; // of the lists; the last is how many
@group(0) @binding(5) var<storage, read_write> rows: array<f32>;
@group(0) @binding(6) var<storage, read_write> moment1: array<f32>;
@group(0) @binding(7) var<storage, read_write> moment2: array<f32>;
@group(0) @binding(8) var<storage, read_write> state: array<u32>;
var<workgroup> wrong: array<atomic<u32>, 16>;

// Which count of steps a column uses: see `optimiser.COLUMN_COUNTS`.
fn count_of(k: u32) -> u32 {
    return select(0u, 1u, k == OPACITY) + select(0u, 2u, k >= SH_REST)
        + select(0u, 1u, k >= DEGREE_2) + select(0u, 1u, k >= DEGREE_3);
}

fn rate_of(k: u32) -> f32 {
    if (k < ROTATION) { return p.means; }
    if (k < LOG_SCALE) { return p.rotation; }
    if (k < OPACITY) { return p.scale; }
    return select(select(p.rest, p.dc, k < SH_REST), p.opacity, k < SH);
}

// 1 / (1 - beta^t). Near 1, beta^t would lose digits: there its series is used.
fn correction(log_beta: f32, t: f32) -> f32 {
    let x = log_beta * t;
    let series = 1.0 + x / 2.0 * (1.0 + x / 3.0 * (1.0 + x / 4.0 * (1.0 + x / 5.0)));
    return 1.0 / select(1.0 - exp(x), -x * series, x > -0.1);
}

// Whether the splat of this lane is visible, with gradients that are neither too large nor broken. Its
// `used` columns are shared by 16 lanes, which call this together. Nothing is usable if the lists held
// more entries than there was room for.
fn usable(i: u32, lane: u32, own_row: u32) -> bool {
    let seen = i < p.n && ends[p.n] <= p.room && keys[min(i, p.n - 1u)] != NOWHERE;
    let used = select(0u, p.used, seen);
    if (lane == 0u) { atomicStore(&wrong[own_row], 0u); }
    workgroupBarrier();
    for (var k = lane; k < used; k += 16u) {
        let g = gradient(i * p.columns, k);
        if (!is_finite(g) || abs(g) > LARGEST_GRADIENT) { atomicStore(&wrong[own_row], 1u); }
    }
    workgroupBarrier();
    return seen && atomicLoad(&wrong[own_row]) == 0u;
}

// Column k of the row at `first`; by a mean, per extent.
fn gradient(first: u32, k: u32) -> f32 {
    return gradients[first + k] * select(1.0, p.extent, k < ROTATION);
}

// Move the visible splats, 16 in a group, with 16 lanes for the columns of each.
@compute @workgroup_size(256)
fn move_splats(at_work: Place) {
    let lane = at_work.lane % 16u;
    let own_row = at_work.lane / 16u;
    let i = group_of(at_work) * 16u + own_row;
    let moved = usable(i, lane, own_row);
    let own = i * STATE;
    for (var k = lane; moved && k < p.used; k += 16u) {
        let at = i * p.columns + k;
        let g = gradient(i * p.columns, k);
        let count = count_of(k);
        let t = f32(max(state[own + count] + select(0u, 1u, count < p.groups), 1u));
        let m = BETA1 * moment1[at] + (1.0 - BETA1) * g;
        moment1[at] = m;
        let first = m * correction(LOG_BETA1, t);
        let distance = select(1.0, bitcast<f32>(state[own + DISTANCE]), k < ROTATION);
        let rate = distance * rate_of(k);
        var step = 0.0;
        if (p.damping > 0.0) {
            let h = moment2[at];
            let own_rate = select(rate, rate / p.extent, k < ROTATION);
            let share = clamp(first / (p.damping * h * own_rate + EPSILON), -1.0, 1.0);
            step = select(0.0, rate * share, h > 0.0);
        } else {
            let v = BETA2 * moment2[at] + (1.0 - BETA2) * g * g;
            moment2[at] = v;
            step = rate * first / (sqrt(v * correction(LOG_BETA2, t)) + EPSILON);
        }
        let degree = state[own + SH_DEGREE] + 1u;
        if (k < SH + 3u * degree * degree) { rows[at] -= step; }
    }
    storageBarrier(); // every lane has read the counts before one is written
    if (!moved) { return; }
    if (lane < p.groups) { state[own + lane] += 1u; }
    if (lane == 15u) {
        let norm = length(vec2f(means2d[2u * i] * p.ndc_x, means2d[2u * i + 1u] * p.ndc_y));
        let before = bitcast<f32>(state[own + GRADIENT_SUM]);
        state[own + GRADIENT_SUM] = bitcast<u32>(before + norm);
        state[own + GRADIENT_COUNT] += 1u;
    }
}

// Average the squares of derivatives, in place of gradients, into moment2: see
// `optimiser.average_squares`.
@compute @workgroup_size(256)
fn average_squares(at_work: Place) {
    let lane = at_work.lane % 16u;
    let own_row = at_work.lane / 16u;
    let i = group_of(at_work) * 16u + own_row;
    let known = usable(i, lane, own_row);
    for (var k = lane; known && k < p.used; k += 16u) {
        let at = i * p.columns + k;
        let d = gradient(i * p.columns, k);
        let h = moment2[at];
        moment2[at] = select(d * d, CURVATURE_DECAY * h + (1.0 - CURVATURE_DECAY) * d * d, h > 0.0);
    }
}

fn hashed(number: u32, key: u32) -> u32 {
    var h = number * INCREMENT + key;
    h = (h ^ (h >> SHIFT_1)) * FACTOR_1;
    h = (h ^ (h >> SHIFT_2)) * FACTOR_2;
    return h ^ (h >> 16u);
}

struct Signs { pixels: u32, ignores: u32, key: u32, size: f32 }
@group(0) @binding(0) var<uniform> s: Signs;
@group(0) @binding(1) var<storage, read> photograph: array<u32>; // red, green, blue, mask: a byte each
@group(0) @binding(2) var<storage, read_write> signs: array<f32>;

// signs [3, H, W]: see `gauss_newton.sign_picture`; 0 where the mask ignores.
@compute @workgroup_size(256)
fn sign_picture(at_work: Place) {
    let at = group_of(at_work) * 256u + at_work.lane;
    if (at >= 3u * s.pixels) { return; }
    let bit = (hashed(at / 32u, s.key) >> (at % 32u)) & 1u;
    let ignored = s.ignores != 0u && photograph[at % s.pixels] >> 24u == 0u;
    signs[at] = select(select(-s.size, s.size, bit != 0u), 0.0, ignored);
}

struct Dropped { n: u32, columns: u32, key: u32, views: f32 }
@group(0) @binding(0) var<uniform> d: Dropped;
@group(0) @binding(1) var<storage, read> counts: array<u32>;
@group(0) @binding(2) var<storage, read_write> most: array<u32>;
@group(0) @binding(3) var<storage, read_write> kept: array<f32>;
var<workgroup> largest: atomic<u32>;

// most[0]: the largest count of the steps in which a splat was drawn. One group.
@compute @workgroup_size(256)
fn largest_count(at_work: Place) {
    let lane = at_work.lane;
    if (lane == 0u) { atomicStore(&largest, 0u); }
    workgroupBarrier();
    for (var i = lane; i < d.n; i += 256u) {
        atomicMax(&largest, counts[i * STATE + GRADIENT_COUNT]);
    }
    workgroupBarrier();
    if (lane == 0u) { most[0] = atomicLoad(&largest); }
}

// Make dropped splats invisible in the rows `kept`: see `dropout.Dropout.dropped`.
@compute @workgroup_size(256)
fn drop_out(at_work: Place) {
    let i = group_of(at_work) * 256u + at_work.lane;
    if (i >= d.n) { return; }
    let share = f32(counts[i * STATE + GRADIENT_COUNT] + 1u) / f32(most[0] + 1u);
    let seen_by = max(1.0, d.views * share);
    let scale = VIEW_SCALE / seen_by;
    if (f32(hashed(i / NEIGHBOURHOOD, d.key)) < min(MAX_PROBABILITY, scale * scale) * 4294967296.0) {
        kept[i * d.columns + OPACITY] = INVISIBLE;
    }
}

// Some columns of rows. numbered: whether `numbers` says which rows; fresh: whether those marked NEW
// become zeros.
struct Block {
    n: u32, width: u32, source_columns: u32, source_first: u32, columns: u32, first: u32,
    numbered: u32, fresh: u32,
}
@group(0) @binding(0) var<uniform> b: Block;
@group(0) @binding(1) var<storage, read> source: array<u32>;
@group(0) @binding(2) var<storage, read> numbers: array<u32>;
@group(0) @binding(3) var<storage, read_write> moved_to: array<u32>;

@compute @workgroup_size(256)
fn copy_rows(at_work: Place) {
    let lane = at_work.lane % 16u;
    let i = group_of(at_work) * 16u + at_work.lane / 16u;
    if (i >= b.n) { return; }
    let number = select(i, numbers[i], b.numbered != 0u);
    let zeros = b.fresh != 0u && (number & NEW) != 0u;
    let first = (number % NEW) * b.source_columns + b.source_first;
    for (var k = lane; k < b.width; k += 16u) {
        moved_to[i * b.columns + b.first + k] = select(source[first + k], 0u, zeros);
    }
}
