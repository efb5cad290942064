"""Map a short synthetic log and compare the trajectory with its exact poses."""

from splatbot import Slam, load_config, open_log
from splatbot.evaluation import absolute_error

log = open_log("synthetic:tabletop?trajectory=arm&frames=8&rate=10&width=160&height=120&effects=depth_noise")
slam = Slam(load_config(overrides={"mapping.refine_iterations": 4, "mapping.final_iterations": 10}))
for frame in log:
    result = slam.process(frame)
    print(f"frame {frame.index}: {result.verdict}, {result.gaussians} Gaussians in the map")
slam.finish()  # the final refinement
slam.close()

assert log.ground_truth is not None
error = absolute_error(log.ground_truth, slam.trajectory)
snapshot = slam.snapshot()
snapshot.model.save("map.ply")
print(f"absolute trajectory error: {1e3 * error.rmse:.2f} mm over {len(slam.trajectory)} frames")
print(f"map.ply holds {len(snapshot.model)} Gaussians, map version {snapshot.map_version}")
