"""Hexapods of ball screws that turn with universal joints (6-UPU), whose axes may not meet."""

from __future__ import annotations

import numpy as np

from pkmcal.mechanisms import MechanismDocument, load_mechanism, machine_from_document

LEAD = 0.005


def screw_hexapod(lead=LEAD, turned=1.0):
    """gough-stewart with axes that are horizontal and square to the legs at home.

    turned : sign of the platform's axes, which changes nothing.
    """
    plain = load_mechanism("gough-stewart")
    a, b, T = plain.base_centers(), plain.platform_centers(), plain.home()
    axes = np.cross([0.0, 0.0, 1.0], b + T[:3, 3] - a)
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    document = plain.document
    legs = tuple(
        leg.model_copy(
            update={
                "base": leg.base.model_copy(update={"joint": "universal", "axis": tuple(axis)}),
                "platform": leg.platform.model_copy(
                    update={"axis": tuple(turned * x for x in axis)}
                ),
                "length": leg.length.model_copy(update={"lead": lead}),
            }
        )
        for leg, axis in zip(document.legs, axes.tolist(), strict=True)
    )
    update = {"name": "screw-hexapod", "legs": legs}
    return machine_from_document(
        MechanismDocument.model_validate(dict(document.model_copy(update=update)))
    )


def offset_fields(base, platform, tubes=False):
    """Fields of a hexapod whose joints' second axes lie at offsets, m, from their first ones."""
    fields = screw_hexapod(0.0).to_document()
    for leg in fields["legs"]:
        del leg["length"]["lead"]
        for end, offset in (("base", base), ("platform", platform)):
            if offset is None:
                del leg[end]["axis"]
            else:
                leg[end]["offset"] = offset
        if not tubes:
            leg["tubes"] = []
    return fields
