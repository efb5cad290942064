// What a web page does with roslibjs; `told` fills as answers come.
const told = {};
let waiting = 0;
const pending = () => waiting;

const record = (key, value) => {
  if (!(key in told)) {
    told[key] = value;
    waiting -= 1;
  }
};

const bytesOf = (data) => (typeof data === "string" ? atob(data).length : data.length);

const call = (ros, name, request, done, failed) =>
  new ROSLIB.Service({ ros, name, serviceType: "any/srv/Any" }).callService(
    new ROSLIB.ServiceRequest(request), done, failed);

const start = (url) => {
  const home = [0.0, -0.785398, 0.0, -2.356194, 0.0, 1.570796, 0.785398];
  const joints = home.map((q, i) => ({ joint_name: `panda_joint${i + 1}`, position: q + (i === 0 ? 0.3 : 0) }));
  for (const compression of ["none", "png", "cbor"]) {
    const ros = new ROSLIB.Ros({ url });
    const points = new ROSLIB.Topic({ ros, name: "/map/points", messageType: "sensor_msgs/PointCloud2", compression });
    const odom = new ROSLIB.Topic({ ros, name: "/odom", messageType: "nav_msgs/Odometry", compression, throttle_rate: 50 });
    waiting += 2;
    points.subscribe((m) => record(`points ${compression}`, { width: m.width, bytes: bytesOf(m.data) }));
    odom.subscribe((m) => {
      const { position: p, orientation: q } = m.pose.pose;
      record(`odom ${compression}`, { x: p.x, y: p.y, z: p.z, qz: q.z });
    });
  }
  const ros = new ROSLIB.Ros({ url });
  waiting += 2;
  call(ros, "/plan_kinematic_path",
    { motion_plan_request: { goal_constraints: [{ joint_constraints: joints }], allowed_planning_time: 0.2 } },
    (answer) => record("plan", answer.motion_plan_response.error_code.val), (error) => record("plan", error));
  call(ros, "/nowhere", {}, () => record("error", "none"), (error) => record("error", String(error)));
  return 1;
};
