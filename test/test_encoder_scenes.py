"""The encoder with real cameras: lidar points lift into their cells, and images can be fitted to lidar heights."""

import numpy as np
import pytest
import torch

from monoforce_ros.core import transform_points
from monoforce_ros.datasets.rough import LIDAR_FRAME, RoughScene
from monoforce_ros.encoder import EncoderConfig, letterbox
from monoforce_ros.encoder.lift import feature_rays, map_cells

CONFIG = EncoderConfig()


@pytest.mark.parametrize("name", ["husky_robingas", "tradr_robingas", "tradr_rough"])
def test_lidar_points_lifted_through_their_pixels_land_in_their_cells(real_data, name):
    scene = RoughScene.open(real_data / "rough" / name)
    stamp = int(scene.cloud_stamps[0])
    cloud = transform_points(scene.base_from_sensors[LIDAR_FRAME], scene.cloud(stamp))
    cloud = cloud[np.isfinite(cloud).all(axis=1) & (np.abs(cloud[:, :2]) < 6.0).all(axis=1)]
    cloud = cloud[np.abs(cloud[:, 2]) < 2.0]
    portrait = distorted = 0
    for camera_name in scene.images(stamp):
        camera, pose = scene.cameras[camera_name], scene.base_from_sensors[camera_name]
        portrait += camera.height > camera.width
        distorted += camera.is_distorted
        in_camera = transform_points(np.linalg.inv(pose), cloud)
        pixels, visible = camera.project(in_camera)
        if visible.sum() < 200:  # An upward camera has no points near the robot in view.
            continue
        points, seen, depth = cloud[visible], pixels[visible], in_camera[visible, 2:3]
        lifted = transform_points(pose, camera.rays(seen) * depth)
        assert np.median(np.linalg.norm(lifted - points, axis=1)) < 1e-3
        cells = [map_cells(torch.from_numpy(p), CONFIG).numpy() for p in (points, lifted)]
        assert (cells[0] == cells[1]).mean() > 0.98
        # The ray of a pixel's feature is within the feature's width of the pixel's ray.
        rays = feature_rays(camera, CONFIG.feature_rows, CONFIG.feature_columns)
        # The letterboxed image keeps the aspect ratio of the camera's.
        affine = letterbox(camera.width, camera.height, CONFIG.feature_columns / CONFIG.feature_rows)
        place = np.linalg.solve(affine[:, :2], ((seen + 0.5) / [camera.width, camera.height] - affine[:, 2]).T).T
        column, row = (place * [CONFIG.feature_columns, CONFIG.feature_rows]).astype(int).T
        away = np.abs(rays[row, column] - camera.rays(seen))[:, :2]
        inside = np.isfinite(away).all(axis=1)
        # Features on the border of the image have their centres outside.
        assert inside.mean() > 0.9
        away = away[inside]
        width = np.nanmax(np.abs(np.diff(rays[..., 0], axis=1))), np.nanmax(np.abs(np.diff(rays[..., 1], axis=0)))
        assert (away <= 0.6 * np.array(width)).mean() > 0.99
    assert distorted >= 3 and (name != "tradr_robingas" or portrait >= 1)


def test_an_encoder_can_fit_lidar_heights_from_images(real_data, one_thread):
    from overfit_scenes import overfit, read_scene

    config = EncoderConfig(image_width=160, image_height=128, resolution=0.2, depth_bins=32)
    scene = read_scene(real_data / "rough" / "tradr_robingas", config)
    _, first = overfit([scene], config, 1, quiet=True)
    _, errors = overfit([scene], config, 40, quiet=True)
    # benchmarks/overfit_scenes.py trains to convergence.
    assert errors[0] < 0.08 and first[0] > 0.15
