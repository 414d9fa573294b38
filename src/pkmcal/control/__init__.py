"""Visual servoing by the legs' directions and edges in the image, [B] 4-9: laws, simulation,
analysis.
"""
