"""The front end makes tracks of stereo images. `track` is its entry; OpenCV is imported only when it runs.

`rectify` makes equal pinholes of the pair; `tracker` follows features from frame to frame with `detect` (corners),
`match` (first disparity), `flow` (Lucas-Kanade), `template` (comparison with first sight) and `geometry.stereo_motion`
(consensus); `rotation` calibrates the right camera at the same time.
"""
