"""A street drive, rendered: procedurally painted fronts, trees, people and cars, exact camera poses, full revisits.

Everything follows from `SimulationSettings`: the same settings give the same bytes, in whatever order frames are asked.

    settings.py   what a user may ask            route.py      the closed street that is driven
    street.py     lots, trees, lamps, crossings  districts.py  what the buildings of a quarter look like
    facades.py, ground.py, nature.py, vehicles.py, people.py   painting
    light.py, shadows.py, sky.py                 light         surface.py, quads.py  painted rectangles
    buildings.py, furniture.py, parked.py        placing       scene.py      the standing world of one lap
    actors.py     who moves                      camera.py, render.py  rectangles to pixels
    drive.py      frames                         write.py      a drive on disk
"""

from loopclosure.images.simulator.camera import Camera, Pose
from loopclosure.images.simulator.drive import Drive, SimulatedFrame
from loopclosure.images.simulator.settings import SimulationSettings
from loopclosure.images.simulator.write import simulate, true_pairs

__all__ = ["Camera", "Drive", "Pose", "SimulatedFrame", "SimulationSettings", "simulate", "true_pairs"]
