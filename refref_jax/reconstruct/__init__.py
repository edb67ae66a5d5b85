"""R3F: from posed masks to geometry, with no step by hand.

The hull of the masks is a scalar grid (`visual_hull`), its zero set a mesh (`isosurface`), which is
cleaned, smoothed and meshed anew (`refinement`); `comparison` says how far it is from a true mesh,
and from masks. A field that is trained on the masks (`occupancy`, the paper's way) gives such a
grid too; one from elsewhere enters at `isosurface`.
"""
