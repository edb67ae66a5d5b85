"""The generator of the data set: objects, backgrounds, cameras, and their rendering in Blender.

Nothing here is imported by `refref_jax`. Blender lives in an environment of its own
(`make dataset-env`): only `blender_worker`, its two neighbours and `export_monkey` import it. They
are started as processes, spoken to by JSON lines, and leave files.
"""
