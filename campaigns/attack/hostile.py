"""Numbers and texts that break programs, and the canary that tells whether code ran."""

from __future__ import annotations

from pathlib import Path
from random import Random

NUMBERS = (
    0,
    1,
    0x7F,
    0xFF,
    0xFFFF,
    0x10000,
    2**31 - 1,
    2**31,
    2**32 - 2,
    2**32 - 1,
    2**32,
    2**40,
    2**53 + 1,
    2**63 - 1,
    2**63,
    2**64 - 1,
)


def number(rng: Random, bits: int = 64) -> int:
    """Return a number at the edge of something, of at most so many bits."""
    choice = rng.choice(NUMBERS) if rng.random() < 0.8 else rng.getrandbits(bits)
    return (choice + rng.choice((-1, 0, 0, 0, 1))) % 2**bits


def shell_texts(canary: Path) -> list[str]:
    """Return texts that run something when a shell gets them unquoted."""
    touch = f"echo shell > {canary}"
    return [
        f"$({touch})",
        f"`{touch}`",
        f"; {touch} ;",
        f"' ; {touch} ; '",
        f'" ; {touch} ; "',
        f"x\n{touch}\n",
        f"x && {touch} #",
        f"| {touch}",
        f"\\'; {touch} #",
        f"-o {canary}",
        f"--output={canary}",
        f"!{touch}",
    ]


def texts(canary: Path) -> list[str]:
    """Return texts for whatever prints names: terminal escapes, floods, tricks with paths."""
    return [
        "\x1b]0;owned\x07",
        "\x1b[2J\x1b[H\x1b[31mred",
        "a\rrsltrace: identical",
        "a\x08\x08\x08b",
        "\x9b31mC1",
        "\u202eevil\u202c",
        "a\nrsltrace: error: not true",
        "a\0b",
        "\x7f\x1b(0",
        "\x1b_Gi=1,a=T;AAAA\x1b\\",
        "",
        " ",
        "/",
        "//",
        "~",
        "..",
        "../" * 20 + "etc/passwd",
        "A" * 100_000,
        "é" * 3000,
        "%s%n%x{0}{a.__class__}",
        "[bold red]markup[/bold red][/]",
        "<script>alert(1)</script>",
        "]]>&xxe;",
        "::error file=x::injected%0A",
        "*?[a-z]{x,y}",
        "--help",
        "\u2028\u2029\ufeff\u200b",
        "\ud83d\ude80".encode("utf-16", "surrogatepass").decode("utf-16"),
        *shell_texts(canary),
    ]


def canary_module(folder: Path, canary: Path, name: str = "canary_nodes") -> None:
    """Write a module and a launch file that tell when they run."""
    folder.mkdir(parents=True, exist_ok=True)
    code = f"open({str(canary)!r}, 'a').write(__name__ + chr(10))\n"
    code += "def main(*a, **k): pass\nhit = after = before = main\n"
    code += "def generate_launch_description(*a, **k): main()\n"
    (folder / f"{name}.py").write_text(code)
    (folder / "evil.launch.py").write_text(code)
