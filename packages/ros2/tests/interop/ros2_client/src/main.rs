//! Publishes joint states at 1 kHz, takes what the monitor publishes and says which nodes there are, as JSON.
//!
//!     ros2_client_peer DOMAIN NAMESPACE TOPIC SAMPLES

use std::{
  env,
  sync::{Arc, Mutex},
  thread::sleep,
  time::{Duration, Instant},
};

use futures::StreamExt;
use ros2_client::{
  ros2::{policy, QosPolicies, QosPolicyBuilder},
  Context, ContextOptions, Message, MessageTypeName, Name, Node, NodeEvent, NodeName, NodeOptions,
};
use serde::{Deserialize, Serialize};
use serde_json::json;

#[derive(Clone, Debug, Default, Serialize, Deserialize)]
struct Header {
  sec: i32,
  nanosec: u32,
  frame_id: String,
}

#[derive(Clone, Debug, Default, Serialize, Deserialize)]
struct JointState {
  header: Header,
  name: Vec<String>,
  position: Vec<f64>,
  velocity: Vec<f64>,
  effort: Vec<f64>,
}
impl Message for JointState {}

#[derive(Clone, Debug, Serialize, Deserialize)]
struct Bool {
  data: bool,
}
impl Message for Bool {}

#[derive(Clone, Debug, Serialize, Deserialize)]
struct KeyValue {
  key: String,
  value: String,
}
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Status {
  level: u8,
  name: String,
  message: String,
  hardware_id: String,
  values: Vec<KeyValue>,
}
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Diagnostics {
  header: Header,
  status: Vec<Status>,
}
impl Message for Diagnostics {}

fn quality(durability: policy::Durability) -> QosPolicies {
  QosPolicyBuilder::new()
    .reliability(policy::Reliability::Reliable { max_blocking_time: ros2_client::ros2::Duration::from_millis(100) })
    .durability(durability)
    .history(policy::History::KeepLast { depth: 1000 })
    .build()
}

fn listen<M: Message + Clone + serde::de::DeserializeOwned + Send + Sync + 'static>(
  node: &mut Node,
  space: &str,
  name: &str,
  package: &str,
  of: &str,
  durability: policy::Durability,
) -> Arc<Mutex<Vec<M>>> {
  let qos = quality(durability);
  let topic = node.create_topic(&Name::new(space, name).unwrap(), MessageTypeName::new(package, of), &qos).unwrap();
  let subscription = node.create_subscription::<M>(&topic, Some(qos)).unwrap();
  let got = Arc::new(Mutex::new(Vec::new()));
  let inbox = got.clone();
  smol::spawn(async move {
    let mut stream = Box::pin(subscription.async_stream());
    while let Some(Ok((message, _))) = stream.next().await {
      inbox.lock().unwrap().push(message);
    }
  })
  .detach();
  got
}

fn main() {
  let words: Vec<String> = env::args().collect();
  let [_, domain, space, topic, samples] = words.as_slice() else {
    panic!("usage: ros2_client_peer DOMAIN NAMESPACE TOPIC SAMPLES");
  };
  let samples: u32 = samples.parse().unwrap();
  let context = Context::with_options(ContextOptions::new().domain_id(domain.parse().unwrap())).unwrap();
  let mut node = context
    .new_node(NodeName::new("/rust", "peer").unwrap(), NodeOptions::new().enable_rosout(false))
    .unwrap();
  smol::spawn(node.spinner().unwrap().spin()).detach();

  let nodes = Arc::new(Mutex::new(Vec::new()));
  let seen = nodes.clone();
  let mut events = Box::pin(node.status_receiver());
  smol::spawn(async move {
    while let Some(event) = events.next().await {
      if let NodeEvent::ROS(info) = event {
        seen.lock().unwrap().extend(info.nodes().iter().map(|one| one.fully_qualified_name()));
      }
    }
  })
  .detach();

  let volatile = policy::Durability::Volatile;
  let torques = listen::<JointState>(&mut node, space, "external_torque", "sensor_msgs", "JointState", volatile);
  let collision =
    listen::<Bool>(&mut node, space, "collision", "std_msgs", "Bool", policy::Durability::TransientLocal);
  let diagnostics =
    listen::<Diagnostics>(&mut node, space, "diagnostics", "diagnostic_msgs", "DiagnosticArray", volatile);
  let qos = quality(volatile);
  let states = node
    .create_topic(&Name::parse(topic).unwrap(), MessageTypeName::new("sensor_msgs", "JointState"), &qos)
    .unwrap();
  let states = node.create_publisher::<JointState>(&states, Some(qos)).unwrap();
  let give_up = Instant::now() + Duration::from_secs(40);
  while diagnostics.lock().unwrap().is_empty() && Instant::now() < give_up {
    sleep(Duration::from_millis(50));
  }
  sleep(Duration::from_secs(2)); // the monitor's readers may be met later than its writers

  let begun = Instant::now();
  for k in 0..samples {
    let t = f64::from(k) * 1e-3;
    let push = if (2000..2300).contains(&k) { -12.0 } else { 0.0 };
    let header = Header { sec: 1_700_000_000 + (k / 1000) as i32, nanosec: k % 1000 * 1_000_000, frame_id: "".into() };
    states
      .publish(JointState {
        header,
        name: vec!["shoulder".into(), "elbow".into()],
        position: vec![(1.1 * t).sin(), (2.3 * t).sin()],
        velocity: vec![1.1 * (1.1 * t).cos(), 2.3 * (2.3 * t).cos()],
        effort: vec![push, 0.0],
      })
      .unwrap();
    sleep((begun + Duration::from_millis(u64::from(k) + 1)).saturating_duration_since(Instant::now()));
  }
  sleep(Duration::from_millis(500));

  let torques = torques.lock().unwrap();
  let stamps: Vec<i64> =
    torques.iter().map(|m| i64::from(m.header.sec) * 1_000_000_000 + i64::from(m.header.nanosec)).collect();
  let effort: Vec<&Vec<f64>> = torques.iter().map(|m| &m.effort).collect();
  let levels: Vec<(u8, String)> =
    diagnostics.lock().unwrap().iter().flat_map(|m| &m.status).map(|s| (s.level, s.message.clone())).collect();
  let collision: Vec<bool> = collision.lock().unwrap().iter().map(|m| m.data).collect();
  println!(
    "{}",
    json!({"stamps": stamps, "effort": effort, "name": torques.first().map(|m| &m.name),
           "collision": collision, "diagnostics": levels, "nodes": *nodes.lock().unwrap()})
  );
}
