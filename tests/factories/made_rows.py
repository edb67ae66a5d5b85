"""Rows of a table as a sweep would measure them, with costs and gains that are easy to reckon."""

from experiments.sweeps.table import Row


def made_row(name="base", *, pace=0.1, quality=25.0, steps=1000, image=1.0, evaluation=""):
    """A row; `pace` in seconds a step, `image` in seconds an image."""
    option, _, value = name.partition("=")
    return Row(
        scene="cube_smcvx_ball",
        name=name,
        option=option if value else "",
        value=value,
        training=f"--preset=tiny --steps={steps}",
        evaluation=evaluation,
        steps=steps,
        seconds_per_step=pace,
        rays_per_second=1024 / pace,
        train_seconds=steps * pace + 10.0,
        startup_seconds=15.0,
        peak_host_mib=900.0,
        peak_device_mib=None,
        psnr=quality + 3.0,
        psnr_masked=quality,
        ssim=0.9,
        distance_mae=0.5,
        distance_mae_masked=None,
        seconds_per_image=image,
        images=20,
    )
