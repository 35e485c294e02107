//! The arm's way from a file to a pose at exposure, against synthetic truth.

use endofield::geometry::space::{Hand, RobotBase};
use endofield::geometry::transform::Transform;
use endofield::robot::kinematics::Arm;
use endofield::robot::pose_buffer::{PoseBuffer, Settings};
use endofield::robot::trajectory::Trajectory;
use endofield::time::Timestamp;

fn joints_at(t: f64) -> [f64; 7] {
    [
        150.0 + 10.0 * t,
        0.3 + 0.05 * t,
        -0.6 - 0.08 * t,
        0.1,
        0.2 * (0.5 * t).sin(),
        -0.3,
        0.1 * t,
    ]
}

fn recorded() -> String {
    let mut text = String::from("timestamp_s,q1,q2,q3,q4,q5,q6,q7\n");
    for i in 0..250 {
        let t = 0.02 * i as f64;
        let values: Vec<String> = joints_at(t).iter().map(|v| format!("{v:.9}")).collect();
        text.push_str(&format!("{t:.6},{}\n", values.join(",")));
    }
    text
}

#[test]
fn joints_poses_and_exposure_agree() {
    let folder = tempfile::tempdir().unwrap();
    let (joints, poses) = (folder.path().join("joints.csv"), folder.path().join("poses.tum"));
    std::fs::write(&joints, recorded()).unwrap();
    let arm = Arm::aesop_3000().unwrap();
    arm.read_joints(&joints).unwrap().write(&poses).unwrap();
    let buffer = PoseBuffer::from_trajectory(&Trajectory::read(&poses).unwrap(), &Settings::default()).unwrap();
    let mut inverted_fits = 0;
    for i in 5..120 {
        let t = 0.04 * i as f64 + 0.003;
        let pose = buffer.pose_at(Timestamp::from_seconds(t)).unwrap();
        let truth: Transform<RobotBase, Hand> = arm.base_from_hand(&joints_at(t)).unwrap();
        let error = |found: &Transform<RobotBase, Hand>| (found.translation() - truth.translation()).norm();
        // The stamps are rounded to 1 ns, the file to 1e-6 mm; the motion's third derivative leaves the rest.
        assert!(
            error(&pose.base_from_hand) < 0.01,
            "{} mm at {t} s",
            error(&pose.base_from_hand)
        );
        let inverted = Transform::from_isometry(pose.base_from_hand.isometry().inverse());
        inverted_fits += usize::from(error(&inverted) < 0.01);
    }
    assert_eq!(inverted_fits, 0, "a test that an inverted transform passes tests nothing");
}
