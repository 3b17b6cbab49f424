"""Score the preset of the paper and the defaults on labelled frames: KITTI_ROOT [SEQUENCE ...].

A folder of your own in SemanticKITTI's layout will do: sequences/00/velodyne/000000.bin (x, y, z,
intensity as float32) and sequences/00/labels/000000.label (a class for each point as uint32).
"""

import sys

from gp_ground_seg import GroundSegmenter, semantic_kitti


def main(root, *sequences):
    """Print the intersection over union of the ground of each preset."""
    for preset in ('paper', 'default'):
        segmenter = GroundSegmenter(preset)
        both = either = 0
        for frame in semantic_kitti.frames(root, *sequences):
            is_ground = segmenter.segment(frame.points).is_ground[frame.is_scored]
            truth = frame.is_ground[frame.is_scored]
            both += (is_ground & truth).sum()
            either += (is_ground | truth).sum()
        print(f'{preset}: ground IoU {both / either:.2%}')


if __name__ == '__main__':
    main(*sys.argv[1:])
