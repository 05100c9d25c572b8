// Lists of the splats of each tile, nearest first: the kernels between the sorts.
//
// A splat's tiles are found row of tiles by row of tiles, from its ellipse. How many they are is
// counted first; then each entry of the lists finds its splat by bisection, so that a splat of
// thousands of tiles is the work of thousands of lanes. Both are the same kernel, because another
// one might round spans in another way.

//include common.wgsl

const LONGEST_RUN = 1024u; // of equal depths that are put in order
const ALL = 0xffffffffu; // more than there are tiles

struct Numbers {
    n: u32,
    capacity: u32,
    tiles_x: u32,
    tiles: u32,
    width: u32,
    tile: u32,
    columns: u32,
    used: u32,
    counting: u32,
}

@group(0) @binding(0) var<uniform> given: Numbers;

// (first, number) of the tiles that an ellipse touches in a row of tiles.
//
// With eta the height in half boxes, the ellipse ends at rho eta +- thin sqrt(1 - eta^2), which is
// furthest out at +-rho. A hair more is taken than rounding could lose.
fn row_span(box: vec4<f32>, rho: f32, thin: f32, tile_row: f32) -> vec2<u32> {
    let tile = f32(given.tile);
    let top = tile_row * tile + 0.5;
    let low = clamp((top - box.y) / box.w - 1e-5, -1.0, 1.0);
    let high = clamp((top + tile - 1 - box.y) / box.w + 1e-5, -1.0, 1.0);
    let out = clamp(vec2(-rho, rho), vec2(low), vec2(high));
    let wide = thin * sqrt(max(1 - out * out, vec2(0.0)));
    let slack = 1e-3 + 1e-5 * box.z + 1e-6 * abs(box.x);
    let left = box.x + box.z * (rho * out.x - wide.x) - slack - 0.5;
    let right = box.x + box.z * (rho * out.y + wide.y) + slack - 0.5;
    let end = f32(given.width) - 1;
    if (right < 0 || left > end) {
        return vec2(0u);
    }
    let first = u32(clamp(left, 0.0, end)) / given.tile;
    return vec2(first, u32(clamp(right, 0.0, end)) / given.tile - first + 1);
}

@group(0) @binding(1) var<storage, read> shapes: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> keys: array<u32>;
@group(0) @binding(3) var<storage, read_write> counts: array<u32>;
@group(0) @binding(4) var<storage, read> ordered: array<u32>;
@group(0) @binding(5) var<storage, read> ends: array<u32>; // [n + 1], entries before each splat
@group(0) @binding(6) var<storage, read_write> tile_of: array<u32>;
@group(0) @binding(7) var<storage, read_write> row_of: array<u32>;

// Counting: counts [n], the number of tiles that each splat touches, 0 if it is not visible. Else
// tile_of, row_of [capacity]: the tile and the splat of each entry, splats nearest first; the number
// of tiles beyond the last entry.
@compute @workgroup_size(64)
fn tiles(here: Place) {
    let e = number_of(here);
    if (e >= select(given.capacity, given.n, given.counting != 0)) {
        return;
    }
    var row = e;
    var left = ALL;
    var shown = false;
    if (given.counting != 0) {
        shown = keys[e] != NOWHERE;
    } else if (e < ends[given.n]) {
        var low = 0u; // of the splats, the last with entries that begin at or before e
        var high = given.n;
        while (high - low > 1) {
            let middle = (low + high) / 2;
            if (ends[middle] <= e) {
                low = middle;
            } else {
                high = middle;
            }
        }
        row = ordered[low];
        left = e - ends[low];
        shown = true;
    }
    var found = given.tiles;
    if (shown) {
        let box = shapes[2 * row];
        let shape = shapes[2 * row + 1];
        for (var tile_row = shape.z; tile_row <= shape.w; tile_row += 1) {
            let span = row_span(box, shape.x, shape.y, tile_row);
            if (left < span.y) {
                found = u32(tile_row) * given.tiles_x + span.x + left;
                break;
            }
            left -= span.y;
        }
    }
    if (given.counting != 0) {
        counts[e] = ALL - left;
    } else {
        tile_of[e] = found;
        row_of[e] = row;
    }
}

@group(0) @binding(1) var<storage, read> rows: array<f32>;
@group(0) @binding(2) var<storage, read> sorted: array<u32>;
@group(0) @binding(3) var<storage, read> order: array<u32>;
@group(0) @binding(4) var<storage, read> counted: array<u32>;
@group(0) @binding(5) var<storage, read_write> new_order: array<u32>;
@group(0) @binding(6) var<storage, read_write> in_order: array<u32>;

// Whether row a comes before row b: by mean, opacity, scales, rotation and SH, as in the reference.
fn comes_before(a: u32, b: u32) -> bool {
    for (var k = 0u; k < given.used; k++) {
        var column = k;
        if (k == 3) {
            column = OPACITY;
        } else if (k > 3 && k < 7) {
            column = k - 4 + LOG_SCALE;
        } else if (k >= 7 && k < SH) {
            column = k - 7 + ROTATION;
        }
        let x = rows[a * given.columns + column];
        let y = rows[b * given.columns + column];
        if (x != y) {
            return x < y;
        }
    }
    return false;
}

// new_order [n]: `order`, with runs of equal depths in the order of the splats' own values; in_order
// [n + 1]: their numbers of tiles, and 0. A splat moves up by those before it that belong behind it,
// and down by those behind it that belong before it. Runs of more than LONGEST_RUN splats stay in
// the order of rows: work grows with the square of a run's length.
@compute @workgroup_size(64)
fn ties(here: Place) {
    let i = number_of(here);
    if (i == given.n) {
        in_order[i] = 0;
    }
    if (i >= given.n) {
        return;
    }
    let key = sorted[i];
    let row = order[i];
    var place = i;
    if (key != NOWHERE) {
        var first = i;
        while (first > 0 && i - first < LONGEST_RUN && sorted[first - 1] == key) {
            first--;
        }
        var end = i + 1;
        while (end < given.n && end - i <= LONGEST_RUN && sorted[end] == key) {
            end++;
        }
        if (end - first <= LONGEST_RUN) {
            place = first;
            for (var rival = first; rival < end; rival++) {
                let other = order[rival];
                // equal splats keep their order
                if (rival < i && !comes_before(row, other) || rival > i && comes_before(other, row)) {
                    place++;
                }
            }
        }
    }
    new_order[place] = row;
    in_order[place] = counted[row];
}

@group(0) @binding(1) var<storage, read> sorted_tiles: array<u32>;
@group(0) @binding(2) var<storage, read> slots: array<u32>;
@group(0) @binding(3) var<storage, read> rows_of: array<u32>;
@group(0) @binding(4) var<storage, read_write> members: array<u32>;
@group(0) @binding(5) var<storage, read_write> starts: array<u32>;
@group(0) @binding(6) var<storage, read> orders: array<u32>;
@group(0) @binding(7) var<storage, read> entries_before: array<u32>;
@group(0) @binding(8) var<storage, read_write> firsts: array<u32>;

// members [capacity]: the row of each entry, tile by tile; starts [tiles + 1]; firsts [n]: the first
// slot of each splat.
@compute @workgroup_size(64)
fn arrange(here: Place) {
    let i = number_of(here);
    if (i < given.capacity) {
        members[i] = rows_of[slots[i]];
    }
    if (i < given.n) {
        firsts[orders[i]] = entries_before[i];
    }
    if (i <= given.tiles) {
        var low = 0u; // entries of tiles before i
        var high = given.capacity;
        while (low < high) {
            let middle = (low + high) / 2;
            if (sorted_tiles[middle] < i) {
                low = middle + 1;
            } else {
                high = middle;
            }
        }
        starts[i] = low;
    }
}
