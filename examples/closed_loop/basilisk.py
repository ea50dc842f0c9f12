"""Optical navigation in an unmodified Basilisk (bsk 2.12), whose pictures come from `spacesim serve boxsat`.

    python examples/closed_loop/basilisk.py [PORT] [MINUTES] [FOLDER]

A chaser 12 m from a drifting, tumbling target takes a picture every 2 s, finds the target's centroid in it, and turns
there: vizInterface, opNavPoint, mrpFeedback and a spacecraft, as in Basilisk's own OpNav scenarios, whose circle finder
is not in the wheel. Prints a JSON object a picture. A second camera looks from elsewhere on the chaser, turned; its
pictures go to FOLDER.
"""

import ctypes
import io
import json
import sys
from pathlib import Path

import numpy as np
from Basilisk.architecture import messaging, sysModel
from Basilisk.fswAlgorithms import mrpFeedback, opNavPoint
from Basilisk.simulation import extForceTorque, simpleNav, spacecraft, vizInterface
from Basilisk.utilities import RigidBodyKinematics as rbk  # noqa: N813
from Basilisk.utilities import SimulationBaseClass, macros, vizSupport
from PIL import Image

PORT = sys.argv[1] if len(sys.argv) > 1 else "5556"
MINUTES = float(sys.argv[2]) if len(sys.argv) > 2 else 4.0
FOLDER = Path(sys.argv[3]) if len(sys.argv) > 3 else None
SECONDS = 2.0  #: between two pictures
SIZE, FOV = (96, 80), np.radians(30.0)
LEVER = [0.0, 0.2, 0.4]  #: metres, body axes: where the camera is, which looks along the body's z axis
SECOND = {"cameraPos_B": [0.5, -0.3, 0.1], "sigma_CB": [0.03, -0.04, 0.2]}


class CentroidFinder(sysModel.SysModel):
    """Finds the direction of what is bright in a picture of `viz`."""

    def __init__(self, viz, states):
        super().__init__()
        self.pictures, self.others = messaging.CameraImageMsgReader(), messaging.CameraImageMsgReader()
        self.pictures.subscribeTo(viz.opnavImageOutMsgs[0])
        self.others.subscribeTo(viz.opnavImageOutMsgs[1])
        self.opNavOutMsg, self.states, self.taken = messaging.OpNavMsg(), states, -1

    def UpdateState(self, now):  # noqa: N802
        image, found = self.pictures(), messaging.OpNavMsgPayload()
        if image.valid and image.timeTag != self.taken:
            self.taken = image.timeTag
            grey = np.asarray(Image.open(io.BytesIO(content_of(image))).convert("L")) / 255.0
            other = self.others()
            if FOLDER and other.valid:
                (FOLDER / f"{now * 1e-9:05.1f}.png").write_bytes(content_of(other))
            rows, columns = np.nonzero(grey > 0.02)
            if len(rows):
                focal = 0.5 * SIZE[1] / np.tan(0.5 * FOV)
                x, y = columns.mean() + 0.5 - 0.5 * SIZE[0], rows.mean() + 0.5 - 0.5 * SIZE[1]
                heading = np.array([x, y, focal]) / np.hypot(np.hypot(x, y), focal)
                found.valid, found.r_BN_C = 1, (-heading).tolist()
                self.tell(now, heading)
        self.opNavOutMsg.write(found, now, self.moduleID)

    def tell(self, now, heading):
        """Where the target is by the picture, and by the states of the simulation."""
        chaser, target = (message.read() for message in self.states)
        true = rbk.MRP2C(chaser.sigma_BN) @ (np.array(target.r_BN_N) - np.array(chaser.r_BN_N)) - LEVER
        off, error = (float(np.degrees(np.arccos(v / np.linalg.norm(true)))) for v in (true[2], true @ heading))
        seen = {"seconds": now * 1e-9, "off_axis_deg": off, "centroid_error_deg": error}
        pose = {"chaser": [chaser.r_BN_N, chaser.sigma_BN], "target": [target.r_BN_N, target.sigma_BN]}
        print(json.dumps({**seen, **pose, "sun": behind.tolist()}), flush=True)


def content_of(image):
    """Bytes of the PNG file that an image message points to."""
    return ctypes.string_at(int(image.imagePointer), image.imageBufferLength)


def craft(name, position, velocity, sigma, omega):
    """A spacecraft of 100 kg, adrift."""
    body = spacecraft.Spacecraft()
    body.ModelTag, body.hub.mHub = name, 100.0
    body.hub.IHubPntBc_B = np.diag([10.0, 12.0, 8.0]).tolist()
    body.hub.r_CN_NInit, body.hub.v_CN_NInit = position, velocity
    body.hub.sigma_BNInit, body.hub.omega_BN_BInit = [[s] for s in sigma], [[w] for w in omega]
    return body


simulation = SimulationBaseClass.SimBaseClass()
process = simulation.CreateNewProcess("all")
process.addTask(simulation.CreateNewTask("task", macros.sec2nano(0.5)))
chaser = craft("chaser", [7.0e6, 0, 0], [0, 7.5e3, 0], [0.1, 0.2, -0.3], [0.0, 0.0, 0.0])
start = np.array([0.1, -0.06, 1.0]) / np.linalg.norm([0.1, -0.06, 1.0])  # off the axis at first
away = 12.0 * rbk.MRP2C([0.1, 0.2, -0.3]).T @ start
there = (np.array([7.0e6, 0, 0]) + away).tolist()
target = craft("boxsat", there, [0.004, 7.5e3, 0.006], [0.3, 0, 0.1], [0.004, 0.006, -0.003])
actuator, navigation = extForceTorque.ExtForceTorque(), simpleNav.SimpleNav()
chaser.addDynamicEffector(actuator)
navigation.scStateInMsg.subscribeTo(chaser.scStateOutMsg)

for body in (chaser, target, actuator, navigation):
    simulation.AddModelToTask("task", body)
viz = vizSupport.enableUnityVisualization(simulation, "task", [chaser, target], noDisplay=True)
viz.reqPortNumber = PORT
sun = vizInterface.GravBodyInfo()
sun.bodyName = "sun"
behind = -1e10 * away + 5e10 * np.cross([0.0, 0, 1], away / 12)  # metres: the chaser, a little aside
sun_message = messaging.SpicePlanetStateMsg().write(
    messaging.SpicePlanetStateMsgPayload(PositionVector=behind.tolist())
)
viz.gravBodyInformation = vizInterface.GravBodyInfoVector([sun])
viz.spiceInMsgs = messaging.SpicePlanetStateMsgInMsgsVector([sun_message.addSubscriber()])
cameras = []
for number, mount in enumerate(({"cameraPos_B": LEVER}, SECOND), start=1):
    lens = {"fieldOfView": FOV, "resolution": SIZE, "renderRate": macros.sec2nano(SECONDS)}
    settings = messaging.CameraConfigMsgPayload(cameraID=number, isOn=1, parentName="chaser", **lens, **mount)
    cameras.append(messaging.CameraConfigMsg().write(settings))
    viz.addCamMsgToModule(cameras[-1])

finder = CentroidFinder(viz, (chaser.scStateOutMsg, target.scStateOutMsg))
pointing = opNavPoint.opNavPoint()
pointing.alignAxis_C, pointing.minUnitMag, pointing.smallAngle, pointing.timeOut = [0.0, 0.0, 1.0], 0.01, 1e-4, 60.0
pointing.opnavDataInMsg.subscribeTo(finder.opNavOutMsg)
pointing.imuInMsg.subscribeTo(navigation.attOutMsg)
pointing.cameraConfigInMsg.subscribeTo(cameras[0])
inertia = messaging.VehicleConfigMsgPayload(ISCPntB_B=[10.0, 0, 0, 0, 12.0, 0, 0, 0, 8.0])
inertia_message = messaging.VehicleConfigMsg().write(inertia)
control = mrpFeedback.mrpFeedback()
control.K, control.P, control.Ki = 0.6, 3.0, -1.0
control.guidInMsg.subscribeTo(pointing.attGuidanceOutMsg)
control.vehConfigInMsg.subscribeTo(inertia_message)
actuator.cmdTorqueInMsg.subscribeTo(control.cmdTorqueOutMsg)
for module in (finder, pointing, control):
    simulation.AddModelToTask("task", module)

simulation.InitializeSimulation()
simulation.ConfigureStopTime(macros.min2nano(MINUTES))
simulation.ExecuteSimulation()
