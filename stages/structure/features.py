"""Features and matches, in the worker process (imports pycolmap)."""

from __future__ import annotations

import math
import os
from pathlib import Path

import pycolmap

from stages.base import memory
from stages.base.memory import MIB
from stages.structure import database as sqlite
from stages.structure.job import CameraGuess, Job
from stages.structure.shares import match_in_shares, pairs_path

FOCAL_WITHOUT_PRIOR = 1.2  # x the longer side: COLMAP's guess where EXIF says nothing
SEQUENTIAL_OVERLAP = 20
# Of a process that matches: at its start, and for each feature its descriptor in bytes and in the
# search index in floats.
PROCESS_MIB = 80.0
FEATURE_BYTES = 5 * 128


def extract(job: Job) -> None:
    """SIFT features of every photograph into the job's database; goes on where it stopped."""
    database = Path(job.database)
    if not database.exists():
        _create(database, job)
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = job.threads
    options.use_gpu = pycolmap.has_cuda
    options.sift.max_num_features = job.max_features
    options.sift.peak_threshold = job.peak_threshold
    pycolmap.extract_features(
        database,
        job.images_root,
        image_names=list(job.names),
        camera_mode=pycolmap.CameraMode.PER_IMAGE,
        extraction_options=options,
        device=_device(),
    )


def match(job: Job) -> None:
    """Match and verify pairs of photographs; pairs that the database holds are not done again."""
    with pycolmap.Database.open(job.database) as database:
        if job.matching == "sequential":
            options = pycolmap.SequentialPairingOptions()
            options.overlap = SEQUENTIAL_OVERLAP
            options.quadratic_overlap = True
            pairs = pycolmap.SequentialPairGenerator(options, database).all_pairs()
        else:
            every = pycolmap.ExhaustivePairingOptions()
            pairs = pycolmap.ExhaustivePairGenerator(every, database).all_pairs()
    wanted = sorted({(min(pair), max(pair)) for pair in pairs})
    match_in_shares(job, wanted, _processes(job))


def _processes(job: Job) -> int:
    """One a core, as long as half of the free memory holds what they keep of every photograph."""
    if pycolmap.has_cuda:
        return 1
    each_mib = PROCESS_MIB + len(job.names) * job.max_features * FEATURE_BYTES / MIB
    available_mib = memory.available_mib() or math.inf
    return max(1, int(min(job.threads, 0.5 * available_mib / each_mib)))


def match_share(job: Job) -> None:
    """Match and verify the pairs of one share; see `shares`."""
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = 1
    matching.use_gpu = pycolmap.has_cuda
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = pairs_path(Path(job.database))
    pycolmap.match_image_pairs(
        job.database,
        matching_options=matching,
        pairing_options=pairing,
        verification_options=_verification(job),
        device=_device(),
    )


def _verification(job: Job) -> pycolmap.TwoViewGeometryOptions:
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = job.seed
    options.compute_relative_pose = True  # also tells a turn on the spot from a planar scene
    options.filter_stationary_matches = job.drop_stationary
    return options


def _device() -> pycolmap.Device:
    return pycolmap.Device.auto if pycolmap.has_cuda else pycolmap.Device.cpu


def _create(path: Path, job: Job) -> None:
    """A database with the cameras and photographs, ids = position + 1.

    Written by hand because COLMAP numbers photographs in the order in which its threads finish,
    and trusts EXIF focal lengths that a resize made wrong. Appears under its name when complete.
    """
    partial = path.with_name(path.name + ".partial")
    sqlite.delete(partial)
    database = pycolmap.Database.open(partial)
    for camera_id, guess in enumerate(job.cameras, 1):
        camera = _camera(camera_id, guess)
        database.write_camera(camera, use_camera_id=True)
        rig = pycolmap.Rig()
        rig.rig_id = camera_id
        rig.add_ref_sensor(camera.sensor_id)
        database.write_rig(rig, use_rig_id=True)
    for image_id, (name, position) in enumerate(zip(job.names, job.camera_of, strict=True), 1):
        image = pycolmap.Image()
        image.image_id = image_id
        image.name = name
        image.camera_id = position + 1
        database.write_image(image, use_image_id=True)
        frame = pycolmap.Frame()
        frame.frame_id = image_id
        frame.rig_id = position + 1
        frame.add_data_id(image.data_id)
        database.write_frame(frame, use_frame_id=True)
    database.close()
    os.replace(partial, path)


def _camera(camera_id: int, guess: CameraGuess) -> pycolmap.Camera:
    focal_px = guess.focal_px or FOCAL_WITHOUT_PRIOR * max(guess.width, guess.height)
    camera = pycolmap.Camera.create_from_model_name(
        camera_id, "SIMPLE_RADIAL", focal_px, guess.width, guess.height
    )
    camera.has_prior_focal_length = guess.focal_px is not None
    return camera
