"""The generator of the data set: objects, backgrounds, cameras, and how Blender renders them.

Nothing here is imported by `refref_jax`, and only `blender_worker` imports Blender, in an
environment of its own (`make dataset-env`): it is started as a process, and spoken to by files.
"""
