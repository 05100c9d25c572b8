// Sums of all numbers before each, in place, blocks of 1024: `scan` within blocks, then the same for
// the blocks' sums, which `add` adds. A sum that 32 bits do not hold becomes the largest number.

//include common.wgsl

const LANES = 64u;
const ITEMS = 16u;

@group(0) @binding(0) var<uniform> n: u32;
@group(0) @binding(1) var<storage, read_write> values: array<u32>;
@group(0) @binding(2) var<storage, read_write> sums: array<u32>;
var<workgroup> partial: array<u32, LANES>;

fn plus(a: u32, b: u32) -> u32 {
    return select(a + b, 0xffffffffu, a + b < a);
}

@compute @workgroup_size(LANES)
fn scan(here: Place) {
    let lane = here.lane;
    let block = group_of(here);
    let first = min(n, (block * LANES + lane) * ITEMS);
    let end = min(n, first + ITEMS);
    var total = 0u;
    for (var i = first; i < end; i++) {
        total = plus(total, values[i]);
    }
    partial[lane] = total;
    workgroupBarrier();
    total = 0u;
    for (var k = 0u; k < lane; k++) {
        total = plus(total, partial[k]);
    }
    for (var i = first; i < end; i++) {
        let value = values[i];
        values[i] = total;
        total = plus(total, value);
    }
    if (lane == LANES - 1 && block * LANES * ITEMS < n) {
        sums[block] = total;
    }
}

@compute @workgroup_size(LANES)
fn add(here: Place) {
    let lane = here.lane;
    let block = group_of(here);
    let first = block * LANES * ITEMS;
    for (var i = first + lane; i < min(n, first + LANES * ITEMS); i += LANES) {
        values[i] = plus(values[i], sums[block]);
    }
}
