// Each splat's rows of what the tiles wrote, added up in a fixed order: a workgroup has eight splats,
// and eight lanes for each.

//include common.wgsl

const WIDTH = 9u;
const LANES = 8u;

struct Numbers {
    n: u32,
    capacity: u32,
    largest: u32, // the column of which the largest is taken, or WIDTH
}

@group(0) @binding(0) var<uniform> given: Numbers;
@group(0) @binding(1) var<storage, read> raw: array<f32>; // [capacity, WIDTH]
@group(0) @binding(2) var<storage, read> firsts: array<u32>; // first slot of each splat
@group(0) @binding(3) var<storage, read> counts: array<u32>; // number of its slots
@group(0) @binding(4) var<storage, read_write> sums: array<f32>; // [n, WIDTH]
var<workgroup> parts: array<f32, 576>; // [64, WIDTH]

@compute @workgroup_size(64)
fn add_up(here: Place) {
    let lane = here.lane;
    let i = group_of(here) * 8 + lane / LANES;
    var end = 0u;
    var slot = 0u;
    if (i < given.n) {
        slot = firsts[i] + lane % LANES;
        end = min(firsts[i] + counts[i], given.capacity);
    }
    var total: array<f32, WIDTH>;
    for (; slot < end; slot += LANES) {
        for (var c = 0u; c < WIDTH; c++) {
            let value = raw[slot * WIDTH + c];
            total[c] = select(total[c] + value, max(total[c], value), c == given.largest);
        }
    }
    for (var c = 0u; c < WIDTH; c++) {
        parts[lane * WIDTH + c] = total[c];
    }
    workgroupBarrier();
    for (var c = lane % LANES; c < WIDTH && i < given.n; c += LANES) {
        var found = 0.0;
        for (var k = lane / LANES * LANES; k < lane / LANES * LANES + LANES; k++) {
            let value = parts[k * WIDTH + c];
            found = select(found + value, max(found, value), c == given.largest);
        }
        sums[i * WIDTH + c] = found;
    }
}
