// Each splat's rows of what the tiles wrote, added up in a fixed order.

//include common.wgsl

const SUMS = 9u; // see blend.wgsl

struct Numbers {
    n: u32,
    capacity: u32,
    largest: u32, // column of which not the sum, but the largest is taken
}

@group(0) @binding(0) var<uniform> given: Numbers;
@group(0) @binding(1) var<storage, read> raw: array<f32>; // [capacity, SUMS]
@group(0) @binding(2) var<storage, read> firsts: array<u32>; // first slot of each splat
@group(0) @binding(3) var<storage, read> counts: array<u32>; // number of its slots
@group(0) @binding(4) var<storage, read_write> sums: array<f32>; // [n, SUMS]

@compute @workgroup_size(64)
fn add_up(here: Place) {
    let i = number_of(here) / SUMS;
    let column = number_of(here) % SUMS;
    if (i >= given.n) {
        return;
    }
    let end = min(firsts[i] + counts[i], given.capacity);
    var total = 0.0;
    for (var slot = firsts[i]; slot < end; slot++) {
        let value = raw[slot * SUMS + column];
        total = select(total + value, max(total, value), column == given.largest);
    }
    sums[i * SUMS + column] = total;
}
