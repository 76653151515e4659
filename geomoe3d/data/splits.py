"""The published splits of 3DMatch and their sizes.

Facts of the data set: 48 scenes to train on, 6 to validate (both as used by FCGF, Predator and PointDSC) and
the 8 official test scenes, which nothing may be trained on. No data travel with the package.
"""

from __future__ import annotations

TRAIN_SCENES = (
    "sun3d-brown_bm_1-brown_bm_1",
    "sun3d-brown_cogsci_1-brown_cogsci_1",
    "sun3d-brown_cs_2-brown_cs2",
    "sun3d-brown_cs_3-brown_cs3",
    "sun3d-harvard_c3-hv_c3_1",
    "sun3d-harvard_c5-hv_c5_1",
    "sun3d-harvard_c6-hv_c6_1",
    "sun3d-harvard_c8-hv_c8_3",
    "sun3d-home_bksh-home_bksh_oct_30_2012_scan2_erika",
    "sun3d-hotel_nips2012-nips_4",
    "sun3d-hotel_sf-scan1",
    "sun3d-mit_32_d507-d507_2",
    "sun3d-mit_46_ted_lab1-ted_lab_2",
    "sun3d-mit_76_417-76-417b",
    "sun3d-mit_dorm_next_sj-dorm_next_sj_oct_30_2012_scan1_erika",
    "sun3d-mit_w20_athena-sc_athena_oct_29_2012_scan1_erika",
    "7-scenes-chess",
    "7-scenes-fire",
    "7-scenes-office",
    "7-scenes-pumpkin",
    "7-scenes-stairs",
    *(f"rgbd-scenes-v2-scene_{number:02d}" for number in range(1, 15) if number != 10),
    "bundlefusion-apt0",
    "bundlefusion-apt1",
    "bundlefusion-apt2",
    "bundlefusion-copyroom",
    "bundlefusion-office1",
    "bundlefusion-office2",
    "bundlefusion-office3",
    "analysis-by-synthesis-apt1-kitchen",
    "analysis-by-synthesis-apt1-living",
    "analysis-by-synthesis-apt2-bed",
    "analysis-by-synthesis-apt2-living",
    "analysis-by-synthesis-apt2-luke",
    "analysis-by-synthesis-office2-5a",
    "analysis-by-synthesis-office2-5b",
)

VALIDATION_SCENES = (
    "sun3d-brown_bm_4-brown_bm_4",
    "sun3d-harvard_c11-hv_c11_2",
    "7-scenes-heads",
    "rgbd-scenes-v2-scene_10",
    "bundlefusion-office0",
    "analysis-by-synthesis-apt2-kitchen",
)

# Per test scene: fragments, pairs of 3DMatch.
_TEST = {
    "7-scenes-redkitchen": (60, 506),
    "sun3d-home_at-home_at_scan1_2013_jan_1": (60, 156),
    "sun3d-home_md-home_md_scan9_2012_sep_30": (60, 208),
    "sun3d-hotel_uc-scan3": (55, 226),
    "sun3d-hotel_umd-maryland_hotel1": (57, 104),
    "sun3d-hotel_umd-maryland_hotel3": (37, 54),
    "sun3d-mit_76_studyroom-76-1studyroom2": (66, 292),
    "sun3d-mit_lab_hj-lab_hj_tea_nov_2_2012_scan1_erika": (38, 77),
}

TEST_SCENES = tuple(_TEST)
TEST_FRAGMENTS = {scene: counts[0] for scene, counts in _TEST.items()}
TEST_PAIRS = {scene: counts[1] for scene, counts in _TEST.items()}
"""Pairs of 3DMatch; 1,623 in all."""

SPLITS = ("train", "validation", "test")

PUBLISHED_PAIRS = {"3DMatch": 1623, "3DLoMatch": 1781, "train_info": 20642, "val_info": 1331}
"""Benchmarks, and Predator's lists of training and validation pairs."""


def split_of(scene: str) -> str | None:
    """``train``, ``validation``, ``test``, or None for a scene that 3DMatch does not have.

    Names may carry the sequence that the training archive (``scene@seq-01``) or Predator (``scene_1``)
    appends.
    """
    whole = scene.split("@")[0]
    stem, _, number = whole.rpartition("_")
    for name in (whole, stem) if number.isdigit() else (whole,):
        for split, scenes in zip(SPLITS, (TRAIN_SCENES, VALIDATION_SCENES, TEST_SCENES), strict=True):
            if name in scenes:
                return split
    return None
