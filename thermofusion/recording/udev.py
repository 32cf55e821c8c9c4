"""The rule by which Linux lets whoever sits at the machine open the cameras."""

from __future__ import annotations

from collections.abc import Mapping

RULES_FILE = "/etc/udev/rules.d/60-thermofusion.rules"


def udev_rules(known: Mapping[tuple[int, int], str]) -> str:
    """The rules of all known devices, (vendor, product) -> name, as a file for udev."""
    lines = [
        "# Cameras that thermofusion records: whoever is logged in at this machine may open them (systemd's uaccess).",
        f"# Copy to {RULES_FILE}, then `sudo udevadm control --reload && sudo udevadm trigger`, and plug in again.",
    ]
    for (vendor, product), name in sorted(known.items()):
        ids = f'ATTRS{{idVendor}}=="{vendor:04x}", ATTRS{{idProduct}}=="{product:04x}"'
        lines += [f"# {name}", f'SUBSYSTEM=="usb", {ids}, MODE="0660", TAG+="uaccess"']
        lines.append(f'SUBSYSTEM=="video4linux", {ids}, MODE="0660", TAG+="uaccess"')
    return "\n".join(lines) + "\n"
