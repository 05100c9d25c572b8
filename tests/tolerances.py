"""Every tolerance of the rasteriser's and trainer's tests, with its reason. One place to argue."""

FLOAT32_IMAGE = 1e-5
"""Images by float32 kernels against float64: about 60 roundings of values up to 1 (2^-24 each) and
an exponential good to 2e-7."""

FLOAT32_GRADIENT = 2e-5
"""Gradients, relative to the largest of their kind: sums of up to a few thousand float32 terms."""

FLOAT32_SHIFT = 1e-6
"""The same picture by the same kernels after a change that should not matter."""

FINITE_DIFFERENCE = 1e-5
"""Autograd in float64 against central differences of step 1e-6: truncation and cancellation both
leave about 1e-9; the scenes' curvature takes the rest."""

NEEDLE_1E3 = 1e-4
"""Alpha of a needle of aspect 1e3 with sigma 1000 px: what Cauchy-Binet and Cholesky together
leave of an error of 2.4e-2."""

NEEDLE_1E4 = 1e-3
"""The same for aspect 1e4 and sigma 1e4 px, of an error of 1.0."""

ORACLE = 1e-9
"""The reference against the textbook formula in extended precision."""

WORKED = 6e-5
"""Examples computed by hand are printed to 4 or 5 digits."""

BLEED = 1e-4
"""Light that may still pass when a pixel is finished."""

MANY_LAYERS = 1e-4
"""Gradients through 4000 layers, relative: T recovered by division drifts by 1.3e-5."""

COMPENSATION = 1e-5
"""Opacity compensation of a splat far smaller than a pixel, relative."""

SCALED_QUATERNION = 1e-6
"""Relative; a quaternion's length must not matter."""

LOSS_GRADIENT = 2e-6
"""Gradient of L1 + SSIM, relative to the largest: the mean is removed before squares are taken."""

FLOAT32_OUTPUT = 1e-6
"""The reference's pictures: computed in float64, handed out in float32."""

UNIT_ROTATION = 1e-6
"""R^T R - I of a rotation from a quaternion of any length."""

CLAMP_GRADIENT = 1e-4
"""Beyond the clamp of x/z and y/z, relative: leaving out what the clamp does to z is 4x to 160x."""

CAP_GRADIENT = 1e-4
"""Gradient by opacity 1e-4 off the cap of alpha, relative."""

FIRST_STEP = 0.01
"""How far Adam's first step of a splat may be from its rate; without bias correction by splat it
is 3.16 rates for one first seen late."""

SSIM = 1e-6
"""SSIM and its gradient (relative) by float32 kernels against float64, and SSIM beyond [-1, 1]:
differences of squares without the mean removed are wrong by 1800 % at exposure x 100."""

FAR_FROM_ORIGIN_PX = 1e-3
"""Where a splat is drawn in a capture 6400 km from its origin; with world coordinates in float32
it is 80 px at 1000 km."""

ROBUST_EXTENT = 1.0
"""Powers of two by which a scene's extent may change when one of its cameras strays: a few cameras
are a small sample, but the others' spread still sets it."""

PLACE_PX = 1e-4
"""Where a splat is drawn, found from its picture: float32 offsets within a tile are good to
1e-6 px."""

RMS_45_DB = 10 ** (-45 / 20)
"""Root of the mean squared error of pictures 45 dB apart: under 1.5 of 255 levels."""

ASPECT_TIMES_ANGLE = 0.5
"""Radians by which a file may turn a splat, times its aspect: half its width at its far end."""

EIGHT_BIT_ANGLE = 0.02
"""Radians by which 8 bits a component may turn a rotation: four errors of 1/256, doubled, and what
bringing it back to length 1 adds."""

MESH_VOXELS = 1.0
"""How far a fused surface may lie from the true one, in voxels: marching cubes interpolates within
one, and median depth is the centre of a splat a third as wide."""

LIVE_PICTURE_DB = 40.0
"""What a browser shows of a training against the reference's picture from the same place: all that
lies between is JPEG of quality 92, which leaves 45 to 51 dB of pictures without camera noise."""

FILM_LEVELS = 3
"""Of 255, by which a film's plain colour may differ: luma has 219 levels, chroma 224, and H.264
rounds at quality 17."""

READERS_AGREE = 1e-5
"""Between two readers of one file, in world units, logarithms, 0..1 and degrees: float32 and the
order of its operations."""

SPLAT_BYTES_DEGREES = 2.0
"""Of a rotation in a .splat file: some readers take a byte as b / 127.5 - 1, others, and its first
writer, as (b - 128) / 128; they lie up to 1/128 apart in each component."""

ENGINE_DB = {"playcanvas": 34.0, "spark": 29.0, "three": 26.0}
"""PSNR of a little scene of large splats, web engines against our rasteriser, at least. Measured:
PlayCanvas 36 (16-bit colours); Spark 34, of a .splat 30 (8-bit colours); three 28 and 27 (it cuts
splats at two standard deviations, and draws each primitive of a quantised .glb by itself). Wrong
quaternions, axes or colours come to 20 or less."""

FISHEYE_LEVELS = 2.5
"""Of 255, by which a pixel of a fisheye's face may differ from the colour of its direction: half a
step of rounding in the photograph and in the face, and what cubic interpolation leaves of a colour
that is not linear in the picture."""

FISHEYE_DEPTH = 0.03
"""Relative error of z in a face, of a depth map with a pixel a degree, to 60 degrees from the
photograph's axis: 0.7 pixels to the nearest, times the slope of the cosine there, and rounding of
the face's size."""

REFINED_FISHEYE = 0.6
"""Error of the turns between fisheyes of 320 px after refinement, as a share of that before: a
pixel is half a degree wide there, as much as the turns are off, and 0.46 was measured. At 800 px it
is 0.05."""

BACKGROUND_DB = {"background": 17.5, "outside": 18.0}
"""PSNR of what lies far behind an object, in pictures from where no photograph stood, at least: the
hall around the table, and what its windows show. Measured with four seeds: 18.5 to 18.6, and 19.0
to 19.4. Without splats there, which are large in the world, it was 8.5 to 8.7, and 6.2."""

LEARNT_LESS_DB = 2.0
"""By which PSNR of the background may be below that of what is near. Measured with four seeds: 0.2
at most; 7 where the background was lost."""

UNLEARNT_DB = 0.5
"""By which PSNR of held-out views may fall below what it was earlier in a run: rounds of removal
spend 0.1 of the training views' together. It fell by 8.7 when walls were culled."""

TURNED_DB, TURNED_SSIM = 0.1, 0.003
"""By which training differs in a turned, mirrored or scaled world, in the mean of three seeds.
Measured in six worlds: 0.01 dB and 0.0005; seeds of one world differ by up to 0.12 dB. With first
splats along the world's axes, turned worlds lost 0.09 and 0.18 dB, and 0.007 and 0.012."""
