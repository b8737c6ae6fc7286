"""Sensors on the device: cameras, LiDAR, bird's-eye raster, object list, and faults.

Pure functions of state and map, written for one ego of one world; `vmap` makes the batch. The frame of a
vehicle has its origin on the ground below the middle of the body: x ahead, y left, z up, m.
"""
