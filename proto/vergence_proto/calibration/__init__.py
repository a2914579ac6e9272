"""Calibrations of stereo cameras in the files of the tools that make them.

:func:`load_calibration` recognises the format by its content:

=========  ==========================================================================
format     files
=========  ==========================================================================
vergence   our own JSON, which :func:`write_rig` writes
kalibr     ``camchain.yaml`` with cam0 (left) and cam1
basalt     ``calibration.json`` with two cameras
monado     the calibration JSON of version 2
opencv     ``cv2.FileStorage`` of stereoCalibrate and stereoRectify (YAML, XML, JSON),
           in one file or in two (intrinsics and extrinsics)
ros        two CameraInfo, left and right, as ``camera_calibration`` writes them or as
           the message is printed
euroc      two ``sensor.yaml``, left and right
=========  ==========================================================================
"""

from vergence_proto.calibration.detect import load_calibration
from vergence_proto.calibration.own import write_rig
from vergence_proto.calibration.parts import Calibration

__all__ = ["Calibration", "load_calibration", "write_rig"]
