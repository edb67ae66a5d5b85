"""The generator of the data set: objects, backgrounds, cameras, and their rendering in Blender.

`refref_jax` imports nothing from here. Blender is installed in a separate environment (`make
dataset-env`): only `blender_worker`, its two neighbours and `export_monkey` import it. They run as
processes, communicate by JSON lines, and write files.
"""
