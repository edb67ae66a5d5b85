"""Claim: after every fault the last state is intact, and the work continues to the same result.

    make faults
    python -m benchmarks.faults [--out=FOLDER] [--kills=100] [--only=train,evaluate] [--workers=2]

Commands run at tiny sizes: training, writing of checkpoints, evaluation, reconstruction, benchmark
and the making of a data set. Each is killed (`kill -9`) at random moments and repeated, until its
result is bit for bit that of a command without faults. Then their disk is full, or read-only; two
processes use a run at once; checkpoints, metrics and scenes are damaged or change under a run; the
clock jumps; memory is short. Every fault must end in one line without a traceback, and the work
must continue once its cause is removed. The table says how each try ended; `lost` and `traceback`
are failures. Small disks are `tmpfs` in a namespace of their own (Linux; `unshare`).
"""

import csv
import random
import re
import shlex
import shutil
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import imageio.v3 as iio
from absl import app, flags, logging

from benchmarks import faults_commands
from benchmarks.faults_commands import Command, Ended

_OUT = flags.DEFINE_string("out", "runs/faults", "Folder of all runs, which is replaced.")
_KILLS = flags.DEFINE_integer("kills", 100, "Number of kills, over all commands.", 0)
_ONLY = flags.DEFINE_list("only", None, "Names of the commands; all by default.")
_WORKERS = flags.DEFINE_integer("workers", 2, "Commands at once.", 1)
_SEED = flags.DEFINE_integer("seed", 0, "Random seed of the moments.")
_CSV = flags.DEFINE_string("csv", None, "File to write the table to.")

# Share of the kills of each command.
_SHARES = {
    "train": 0.25,
    "checkpoint": 0.2,
    "evaluate": 0.2,
    "reconstruct": 0.15,
    "benchmark": 0.1,
    "convert": 0.1,
}

# Kills before a command may come to its end.
_IN_A_ROW = 5

# Sizes of small disks, relative to what a command writes.
_DISKS = (0.02, 0.3, 0.7)

_EQUAL, _REFUSED, _TRACEBACK, _LOST = "same result", "one line", "traceback", "lost"

_CLOCK = """import random, time
_time, _ago = time.time, [0.0]
def _jump():
    _ago[0] += random.choice((-1, 1)) * random.uniform(0, 1e5)
    return _time() + _ago[0]
time.time = _jump
"""


class Try(NamedTuple):
    """How one try of a fault ended; `remark` says what was printed, if it was not as it should."""

    fault: str
    command: str
    outcome: str
    remark: str = ""


class Campaign:
    """The commands, their results without faults, and all tries so far."""

    def __init__(self, work: Path) -> None:
        """Makes the scene, and runs every command once without a fault."""
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir(parents=True)
        self.work, self.tries, self._lock = work, [], threading.Lock()
        self.scene = faults_commands.make_scene(work)
        self.trained = work / "whole_train"
        self.commands = faults_commands.commands(self.scene, self.trained)
        self.seconds: dict[str, float] = {}
        self.results: dict[str, str] = {}
        for name, command in self.commands.items():
            if name == "train" or name in chosen():
                out = work / f"whole_{name}"
                for _ in range(2):  # once more for the time when programs are compiled
                    shutil.rmtree(out, ignore_errors=True)
                    ended = self.start(command, out)
                    assert ended.status == 0, ended.printed
                self.seconds[name] = ended.seconds
                self.results[name] = faults_commands.digest(out)

    def start(
        self, command: Command, out: Path, *, again: bool = False, kill: object = None
    ) -> Ended:
        """Runs a command from the start, or again after a fault."""
        if not again:
            command.prepare(out)
        words = [*command.words(out), *(command.again if again else ())]
        return faults_commands.run(faults_commands.line(words), work=self.work, kill=kill)

    def note(self, fault: str, command: str, outcome: str, remark: str = "") -> None:
        """Records how a try ended, and prints it if it is a failure."""
        with self._lock:
            self.tries.append(Try(fault, command, outcome, remark))
        if outcome in (_LOST, _TRACEBACK):
            print(f"{fault}, {command}: {outcome}\n{remark[-3000:]}", flush=True)

    def finish(self, fault: str, name: str, out: Path, *, again: bool = True) -> None:
        """Repeats a command without a fault, and compares its result."""
        ended = self.start(self.commands[name], out, again=again)
        label = self.commands[name].name
        if "Traceback" in ended.printed:
            self.note(fault, label, _TRACEBACK, ended.printed)
        elif ended.status != 0:
            self.note(fault, label, _LOST, ended.printed)
        elif faults_commands.digest(out) != self.results[name]:
            self.note(fault, label, _LOST, f"{out} differs from {self.work / f'whole_{name}'}")
        else:
            self.note(fault, label, _EQUAL)

    def expect(self, fault: str, name: str, ended: Ended, *words: str) -> bool:
        """Records whether a command ended in one line with some words; returns whether it did.

        A benchmark has a line for each job that failed.
        """
        starts = ("error: ", "failed: ")
        lines = [each for each in ended.printed.splitlines() if each.startswith(starts)]
        found = ended.status != 0 and lines and all(word in ended.printed for word in words)
        broken = "Traceback" in ended.printed or "Fatal Python error" in ended.printed
        outcome = _TRACEBACK if broken else _REFUSED if found else _LOST
        self.note(fault, self.commands[name].name, outcome, "" if found else ended.printed)
        return outcome == _REFUSED


def chosen() -> list[str]:
    """Returns the names of the commands of this campaign."""
    return _ONLY.value or list(_SHARES)


# ---- kill -9 ----
def kill_and_repeat(campaign: Campaign, name: str, number: int, kills: int) -> None:
    """Kills a command at random moments, repeats it to its end, and compares the result."""
    command, out = campaign.commands[name], campaign.work / f"killed_{name}_{number}"
    chance, again, left = random.Random(f"{_SEED.value} {name} {number}"), False, kills
    for _ in range(4 * kills):  # at most: a command may end before its moment
        if not left:
            break
        before = faults_commands.newest_step(out) if again else -1
        moment = chance.uniform(0.0, campaign.seconds[name])
        kill = _while_writing(out, chance) if name == "checkpoint" else moment
        ended = campaign.start(command, out, again=again, kill=kill)
        faults_commands.wait_for_orphans(out)
        if "Traceback" in ended.printed:
            campaign.note("kill -9", command.name, _TRACEBACK, ended.printed)
        if ended.status >= 0:  # it was faster
            shutil.rmtree(out, ignore_errors=True)
            again = False
            continue
        left -= 1
        again = out.exists() and name != "convert"
        if name == "evaluate" and not (out / "config.json").is_file():
            again = False
        if again and faults_commands.newest_step(out) < before:
            campaign.note("kill -9", command.name, _LOST, f"{out}: step {before} is gone")
    for _ in range(max(0, kills - left - 1)):
        campaign.note("kill -9", command.name, "killed again")
    campaign.finish("kill -9", name, out, again=again)
    shutil.rmtree(out, ignore_errors=True)


def _while_writing(out: Path, chance: random.Random) -> Callable[[], bool]:
    """Returns a condition that holds while one of the next checkpoints is written."""
    number, seen = chance.randrange(1, 4), set[str]()

    def writing() -> bool:
        seen.update(path.name for path in out.glob("checkpoints/*tmp*"))
        return len(seen) >= number

    return writing


# ---- Disks ----
def on_disk(campaign: Campaign, name: str, out: Path, script: str) -> None:
    """Runs a script with an empty disk of its own mounted at a folder; see `_script`."""
    out.mkdir(parents=True)
    words = ["unshare", "--mount", "--map-root-user", "bash", "-c", script]
    ended = faults_commands.run(words, work=campaign.work)
    assert "unshare" not in ended.printed and "mount:" not in ended.printed, ended.printed


def _script(campaign: Campaign, name: str, place: Path, *, first: str, between: str) -> str:
    """Returns a shell script: mount, change, the command, change, the command again, copy."""
    command, out = campaign.commands[name], place / "out"
    start, again = (
        shlex.join(faults_commands.line([*command.words(out), *more]))
        for more in ((), command.again)
    )
    copied = f"cp -r {campaign.trained} {out};" if name == "evaluate" else ""
    return f"""mount -t tmpfs -o size=1g none {place}; {copied} {first}
{start} > {place}.first 2>&1; echo $? >> {place}.first
{between} if [ -e {out}/config.json -o -e {out}/benchmark.json -o {name} = reconstruct ]
then {again} > {place}.second 2>&1; else {start} > {place}.second 2>&1; fi
cp -r {out} {place}.copy"""


def fill_disk(campaign: Campaign, name: str, share: float) -> None:
    """Runs a command on a disk that is too small, and again after it was enlarged."""
    place = campaign.work / f"disk_{name}_{share:g}"
    whole = sum(x.stat().st_size for x in (campaign.work / f"whole_{name}").rglob("*"))
    if name == "evaluate":
        whole -= sum(x.stat().st_size for x in campaign.trained.rglob("*"))
    free = max(4096, int(share * whole))
    room = f"$(( $(df --output=avail -B1 {place} | tail -1) - {free} ))"
    fill = f"head -c {room} /dev/zero > {place}/full;"
    script = _script(campaign, name, place, first=fill, between=f"rm {place}/full;")
    on_disk(campaign, name, place, script)
    _judge(campaign, "disk full", name, place, "disk is full")


def write_nowhere(campaign: Campaign, name: str) -> None:
    """Runs a command on a read-only disk, and again after it became writable."""
    place = campaign.work / f"readonly_{name}"
    readonly, writable = (f"mount -o remount,{mode} {place};" for mode in ("ro", "rw"))
    script = _script(campaign, name, place, first=readonly, between=writable)
    on_disk(campaign, name, place, script)
    _judge(campaign, "read-only folder", name, place, "ead-only")


def _judge(campaign: Campaign, fault: str, name: str, place: Path, words: str) -> None:
    """Records how a script's commands ended, and whether the copy of their result is right."""
    *printed, status = Path(f"{place}.first").read_text("utf-8").splitlines()
    first = Ended(int(status), "\n".join(printed), 0.0)
    label = campaign.commands[name].name
    if first.status == 0:
        campaign.note(fault, label, "there was room")
    else:
        campaign.expect(fault, name, first, words)
    again = Path(f"{place}.second").read_text("utf-8")
    copy = Path(f"{place}.copy")
    same = copy.is_dir() and faults_commands.digest(copy) == campaign.results[name]
    outcome = _EQUAL if same else _TRACEBACK if "Traceback" in again else _LOST
    campaign.note(f"{fault}, then removed", label, outcome, again)


# ---- Damage ----
def share_run(campaign: Campaign) -> None:
    """Starts a second process on a run while the first one trains."""
    command, out = campaign.commands["train"], campaign.work / "shared"
    with ThreadPoolExecutor(1) as pool:
        first = pool.submit(campaign.start, command, out)
        while not (out / "checkpoints").is_dir() and not first.done():
            threading.Event().wait(0.05)
        second = campaign.start(command, out, again=True)
        if second.status == 0:
            campaign.note("run of two processes", command.name, "the first one had ended")
        else:
            campaign.expect("run of two processes", "train", second, "Another process works in")
    campaign.finish("run of two processes", "train", out)


def damage(campaign: Campaign, fault: str, spoil: Callable[[Path], None], *words: str) -> None:
    """Damages an interrupted run, which must say so; then removes the damage and continues."""
    out = campaign.work / fault.replace(" ", "_")
    shutil.copytree(campaign.work / "half", out)
    spoil(out)
    if words:
        ended = campaign.start(campaign.commands["train"], out, again=True)
        campaign.expect(fault, "train", ended, *words)
        shutil.rmtree(out / "checkpoints" / str(faults_commands.newest_step(out)))
    campaign.finish(fault, "train", out)


def _largest(out: Path) -> Path:
    folder = out / "checkpoints" / str(faults_commands.newest_step(out))
    return max(folder.rglob("*"), key=lambda path: path.stat().st_size)


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def _begin_line(out: Path) -> None:
    """Adds the beginning of a line of metrics, as a process that is killed leaves it."""
    with (out / "metrics.jsonl").open("a", encoding="utf-8") as file:
        file.write('{"step": 7, "lo')


def change_scene(campaign: Campaign) -> None:
    """Resumes a run with a scene of which an image has changed, and then with its own."""
    out = campaign.work / "changed"
    shutil.copytree(campaign.work / "half", out)
    scene = shutil.copytree(campaign.scene, campaign.work / "changed_scene" / campaign.scene.name)
    image = next((scene / "train").iterdir())
    iio.imwrite(image, 255 - iio.imread(image))
    moved = faults_commands.commands(scene, campaign.trained)["train"]
    ended = campaign.start(moved, out, again=True)
    campaign.expect("scene that changes", "train", ended, image.stem, "Restore the scene")
    campaign.finish("scene that changes", "train", out)


def jump_clock(campaign: Campaign, name: str) -> None:
    """Runs a command while the time of day jumps by up to a day at every look."""
    folder, out = campaign.work / "clock", campaign.work / f"clock_{name}"
    folder.mkdir(exist_ok=True)
    (folder / "sitecustomize.py").write_text(_CLOCK)
    command = campaign.commands[name]
    command.prepare(out)
    path = f"PYTHONPATH={folder}:{faults_commands.ROOT}"
    words = ["env", path, *faults_commands.line(command.words(out))]
    ended = faults_commands.run(words, work=campaign.work)
    same = ended.status == 0 and faults_commands.digest(out) == campaign.results[name]
    broken = "Traceback" in ended.printed
    outcome = _EQUAL if same and not broken else _TRACEBACK if broken else _LOST
    campaign.note("clock that jumps", command.name, outcome, ended.printed)


def limit_memory(campaign: Campaign) -> None:
    """Trains with batches that do not fit into 2 GiB."""
    command, out = campaign.commands["train"], campaign.work / "memory"
    words = faults_commands.line([*command.words(out), "--samples_per_ray=4096,2048"])
    limited = ["prlimit", f"--data={2 << 30}", *words, "--batch=4096"]
    ended = faults_commands.run(limited, work=campaign.work)
    campaign.expect("memory limited", "train", ended, "batch")


# ---- The campaign ----
def jobs(campaign: Campaign) -> Iterator[tuple[Callable[..., None], tuple[object, ...]]]:
    """Yields all faults as functions with their arguments."""
    for name in chosen():
        kills = round(_KILLS.value * _SHARES[name])
        for number, first in enumerate(range(0, kills, _IN_A_ROW)):
            yield kill_and_repeat, (campaign, name, number, min(_IN_A_ROW, kills - first))
    for name in chosen():
        for share in _DISKS:
            yield fill_disk, (campaign, name, share)
        yield write_nowhere, (campaign, name)
        yield jump_clock, (campaign, name)
    if "train" in chosen():
        yield share_run, (campaign,)
        yield change_scene, (campaign,)
        yield limit_memory, (campaign,)
        cut, flipped = "checkpoint cut short", "checkpoint with a flipped bit"
        yield damage, (campaign, cut, lambda x: _cut(_largest(x)), "damaged", "Remove")
        yield damage, (campaign, flipped, lambda x: _flip(_largest(x)), "damaged", "Remove")
        yield damage, (campaign, "metrics cut short", _begin_line)


def _stop_half_way(campaign: Campaign) -> None:
    """Makes the run that damages are tried on: half of its steps are taken."""
    out = campaign.work / "half"
    command = campaign.commands["train"]
    complete = out / "checkpoints" / "6" / "checksums.json"
    campaign.start(command, out, kill=complete.is_file)
    assert faults_commands.newest_step(out) >= 6


def main(arguments: list[str]) -> None:
    del arguments
    logging.set_verbosity(logging.ERROR)  # Orbax tells of every checkpoint that is read
    campaign = Campaign(Path(_OUT.value).resolve())
    if "train" in chosen():
        _stop_half_way(campaign)
    with ThreadPoolExecutor(_WORKERS.value) as pool:
        for done in [pool.submit(function, *given) for function, given in jobs(campaign)]:
            done.result()
    rows = Counter((each.fault, each.command, each.outcome) for each in campaign.tries)
    print("| fault | command | outcome | tries |\n|---|---|---|---|")
    for (fault, command, outcome), count in sorted(rows.items()):
        print(f"| {fault} | {command} | {outcome} | {count} |")
    if _CSV.value:
        with open(_CSV.value, "w", encoding="utf-8", newline="") as file:
            lines = csv.writer(file, lineterminator="\n")
            lines.writerow(("fault", "command", "outcome", "tries"))
            lines.writerows((*row, count) for row, count in sorted(rows.items()))
    failed = [
        each for each in campaign.tries if re.fullmatch(f"{_LOST}|{_TRACEBACK}", each.outcome)
    ]
    assert not failed, f"{len(failed)} of {len(campaign.tries)} tries failed"


if __name__ == "__main__":
    app.run(main)
