"""Start the service, map a log through it, query distances, plan a motion and send it to a simulated arm."""

from pathlib import Path

from splatbot.client import Client
from splatbot.serving import serving

BASE = {"translation": [0.0, 0.5, 0.0]}  # of the robot in the world, which is the first camera
GOAL = [0.3, -0.8, 0.0, -2.3, 0.0, 1.6, 0.8]

with serving("--data", "maps", log=Path("service.log")) as service, Client(service.url) as client:
    log = "synthetic:tabletop?frames=6&width=160&height=120"
    job = client.create_map("desk", log, robot_base=BASE)
    client.wait(job["id"])
    print(f"map desk has {client.map('desk')['gaussians']} Gaussians")

    found = client.distance("desk", [[0.0, 0.0, 0.5], [0.0, 0.0, 30.0]])
    sigmas = ", ".join(f"{distance:.1f}" for distance in found.distance_sigma)
    print(f"nearest Gaussians: {sigmas} sigma away, map version {found.map_version}")

    plan = client.plan("desk", goal=GOAL)
    print(f"plan of {plan['duration_s']:.2f} s, certified: {plan['certified']}")
    with client.lease("fake") as lease:  # one owner commands the arm; it stops if the owner is gone
        motion = lease.send(plan["id"])
        done = client.wait(motion["id"], under="/v1/trajectories")
    print(f"motion: {done['state']}")
