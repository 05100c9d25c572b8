// Gradients of the splats' parameters, from the sums that blending wrote. The chain rule is that of
// `cpu.projection` and `cpu.splat_kernels`, where it is explained; lengths in the picture are in
// units of the footprint's size.

//include common.wgsl
//include geometry.wgsl

const LARGEST_KEPT = 3.4e38; // no gradient becomes infinite
const LEAST = 1e-37; // a square that vanishes: of a splat 1e18 times as long as wide
const SUMS = 9u; // see blend.wgsl

@group(0) @binding(3) var<storage, read> keys: array<u32>;
@group(0) @binding(4) var<storage, read> records: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read> sums: array<f32>;
@group(0) @binding(6) var<storage, read_write> out: array<f32>;
@group(0) @binding(7) var<storage, read_write> means2d: array<f32>;

fn put(at: u32, value: f32) {
    out[at] = clamp(value, -LARGEST_KEPT, LARGEST_KEPT);
}

fn put_triple(at: u32, value: vec3<f32>) {
    put(at, value.x);
    put(at + 1, value.y);
    put(at + 2, value.z);
}

// SH gradients; returns what the viewing direction adds to the gradient of the mean.
fn colour_gradient(at: u32, i: u32) -> vec3<f32> {
    let d = direction(at);
    let shown = records[4 * i + 2].xyz;
    let clamped = (shown <= vec3(0.0)) | (shown >= vec3(COLOUR_MAX));
    let v = vec3(sums[i * SUMS + 6], sums[i * SUMS + 7], sums[i * SUMS + 8]);
    let g = select(v, vec3(0.0), clamped);
    let values = basis(d.xyz);
    let slopes = basis_slopes(d.xyz);
    var along = vec3(0.0);
    for (var k = 0u; k < COEFFICIENTS; k++) {
        put_triple(at + SH + 3 * k, g * values[k]);
        along += dot(g, triple(at + SH + 3 * k)) * slopes[k];
    }
    return (along - dot(along, d.xyz) * d.xyz) / d.w;
}

fn determinant(f: Footprint) -> f32 {
    return max(f.root * f.root, LEAST);
}

// Gradients with respect to the mean in the picture, and in order to A, B and K of the exponent
// A u^2 + B (v - K u)^2; to ln(1 / z), to the logarithm of the opacity.
struct ExponentGradient {
    mean: vec2<f32>,
    a: f32,
    b: f32,
    k: f32,
    near: f32,
    drawn: f32,
}

fn exponent_gradient(i: u32, f: Footprint, tall: bool) -> ExponentGradient {
    let larger = select(f.a, f.c, tall);
    let k = f.b / larger;
    let by_a = 0.5 / larger;
    let by_b = 0.5 * larger / determinant(f);
    let unit = 1 / f.size;
    let place = select(f.mean.xy, f.mean.yx, tall) * unit;
    let centre = select(view.cam[3].zw, view.cam[3].wz, tall) * unit;
    let origin = records[4 * i + 3].zw * unit;
    let at = i * SUMS;
    let du = origin.x - place.x;
    let dt = origin.y - (place.y - k * place.x);
    let s_1 = sums[at + 5];
    let near_u = sums[at] * unit;
    let near_t = sums[at + 1] * unit;
    let s_u = near_u + du * s_1;
    let s_t = near_t + dt * s_1;
    let by_u = sums[at + 2] * unit * unit + du * near_u;
    let by_t = sums[at + 3] * unit * unit + dt * near_t;
    let s_uu = by_u + du * s_u;
    let s_tt = by_t + dt * s_t;
    let s_ut = sums[at + 4] * unit * unit + du * near_t + dt * s_u;
    let mean = vec2(2 * (by_b * k * s_t - by_a * s_u), -2 * by_b * s_t);
    let q_p = by_a * (by_u + (origin.x - centre.x) * s_u)
        + by_b * (by_t + (origin.y - (centre.y - k * centre.x)) * s_t);
    let q_q = by_a * by_a * s_uu - 2 * by_a * by_b * k * s_ut + by_b * by_b * (1 + k * k) * s_tt;
    return ExponentGradient(
        select(mean.xy, mean.yx, tall), s_uu, s_tt, -2 * by_b * s_ut,
        4 * f.dilation * q_q - 2 * q_p, -s_1,
    );
}

// Gradients of both variances, of the covariance and of the minors; what antialiasing adds to the
// gradient of ln(1 / z).
struct CovarianceGradient {
    var_x: f32,
    var_y: f32,
    cov: f32,
    minors: f32,
    near: f32,
}

fn covariance_gradient(f: Footprint, g: ExponentGradient, tall: bool) -> CovarianceGradient {
    let larger = select(f.a, f.c, tall);
    let det = determinant(f);
    let g_larger = 0.5 * g.b / det - (0.5 * g.a / larger + g.k * f.b / larger) / larger;
    var g_det = -0.5 * g.b * (larger / det) / det;
    var g_minors = 0.0;
    var near = 0.0;
    if (view.cam[5].z != 0) {
        g_det -= 0.5 * g.drawn / det;
        g_minors = 0.5 * g.drawn / max(f.area * f.area, LEAST);
        // the determinant but for the minors, e (a + c), with the dilation that a and c have
        near = g.drawn * (f.dilation * (f.a + f.c)) / det;
    }
    let both = f.dilation * g_det;
    return CovarianceGradient(
        select(g_larger, 0.0, tall) + both, select(0.0, g_larger, tall) + both, g.k / larger,
        g_minors + g_det, near,
    );
}

// Gradient of a quaternion from the gradients of the columns of its rotation matrix.
fn rotation_gradient(at: u32, f: Footprint, r: mat3x3<f32>) {
    let q = f.quaternion;
    let v = q.yzw;
    let turn = vec3(r[1].z - r[2].y, r[2].x - r[0].z, r[0].y - r[1].x);
    let s = vec3(r[1].z + r[2].y, r[2].x + r[0].z, r[0].y + r[1].x);
    let d = vec3(r[0].x, r[1].y, r[2].z);
    let by_v = v.yxx * s.zzy + v.zzy * s.yxx + q.x * turn - 2 * v * (d.yxx + d.zzy);
    let n = 2 * vec4(dot(v, turn), by_v);
    let g = (n - dot(n, q) * q) / f.norm;
    put_triple(at + ROTATION, g.xyz);
    put(at + ROTATION + 3, g.w);
}

// Gradients of scales and rotation; returns those of the Jacobian's last column.
fn shape_gradient(at: u32, f: Footprint, g: CovarianceGradient, drawn: f32) -> vec2<f32> {
    let minors = cross(f.x, f.y);
    let g_x = 2 * g.var_x * f.x + g.cov * f.y + 2 * g.minors * cross(f.y, minors);
    let g_y = 2 * g.var_y * f.y + g.cov * f.x + 2 * g.minors * cross(minors, f.x);
    let kept = f.ratios * f.ratios;
    put_triple(at + LOG_SCALE, (g_x * f.x + g_y * f.y) * kept + drawn * (1 - kept));
    let by_x = g_x * f.scales;
    let by_y = g_y * f.scales;
    let along = view.cam[3].xy / f.at.z;
    var r: mat3x3<f32>;
    for (var k = 0; k < 3; k++) {
        let x = along.x * by_x[k];
        let y = along.y * by_y[k];
        r[k] = rotation() * vec3(x, y, -x * f.slopes.x - y * f.slopes.y);
    }
    rotation_gradient(at, f, r);
    let deep = transpose(f.axes)[2];
    return vec2(dot(by_x, deep), dot(by_y, deep));
}

// out [n, columns], means2d [n, 2]: gradients of the visible rows, zeros elsewhere.
@compute @workgroup_size(64)
fn gradients(here: Place) {
    let i = number_of(here);
    if (i >= view.n) {
        return;
    }
    let at = i * view.columns;
    let shown = keys[i] != NOWHERE;
    for (var k = select(0u, SH + 3 * COEFFICIENTS, shown); k < view.columns; k++) {
        out[at + k] = 0;
    }
    if (!shown) {
        means2d[2 * i] = 0;
        means2d[2 * i + 1] = 0;
        return;
    }
    let f = footprint(at, i);
    let tall = records[4 * i + 3].y != 0;
    let g = exponent_gradient(i, f, tall);
    let mean = g.mean / f.size;
    means2d[2 * i] = mean.x;
    means2d[2 * i + 1] = mean.y;
    put(at + OPACITY, g.drawn / (1 + exp(rows[at + OPACITY])));
    let c = covariance_gradient(f, g, tall);
    let g_deep = shape_gradient(at, f, c, g.drawn);
    // a slope inside its limits moves with the mean; a clamped one does not
    let focal = view.cam[3].xy;
    let by_slope = select(vec2(0.0), -g_deep * focal / f.at.z, f.inside);
    let by_place = (mean * focal + by_slope) / f.at.z;
    let by_depth = -(g.near + c.near + dot(by_slope, f.slopes)) / f.at.z;
    put_triple(at + MEAN, rotation() * vec3(by_place, by_depth) + colour_gradient(at, i));
}
