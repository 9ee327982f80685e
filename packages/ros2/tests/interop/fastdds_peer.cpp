// A ROS 2 peer on Fast DDS: publishes joint states at 1 kHz, receives everything that the monitor publishes, and prints
// what it got as JSON. The types are written down here anew, so that both sides can be wrong only in different ways.
//
//     fastdds_peer DOMAIN NAMESPACE TOPIC SAMPLES
//
// Joint k of (elbow, hand, shoulder) moves as sin(w_k t + phase_k); from 2 s on for 0.3 s the shoulder's torque is -12.

#include <fastcdr/Cdr.h>
#include <fastcdr/FastBuffer.h>
#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/DataReaderListener.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/Topic.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/dds/topic/TypeSupport.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>
#include <fastrtps/utils/IPLocator.h>

#include <array>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <memory>
#include <mutex>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

namespace fast = eprosima::fastdds::dds;
namespace rtps = eprosima::fastrtps::rtps;
using eprosima::fastcdr::Cdr;

namespace {

struct Stamp {
  int32_t sec = 0;
  uint32_t nanosec = 0;
};
struct JointState {
  static constexpr const char* kName = "sensor_msgs::msg::dds_::JointState_";
  Stamp stamp;
  std::string frame_id;
  std::vector<std::string> name;
  std::vector<double> position, velocity, effort;
};
struct Bool {
  static constexpr const char* kName = "std_msgs::msg::dds_::Bool_";
  bool data = false;
};
struct String {
  static constexpr const char* kName = "std_msgs::msg::dds_::String_";
  std::string data;
};
struct Status {
  uint8_t level = 0;
  std::string name, message, hardware_id;
  std::vector<std::array<std::string, 2>> values;
};
struct Diagnostics {
  static constexpr const char* kName = "diagnostic_msgs::msg::dds_::DiagnosticArray_";
  Stamp stamp;
  std::string frame_id;
  std::vector<Status> status;
};
using Gid = std::array<uint8_t, 16>;
struct NodeEntities {
  std::string space, name;
  std::vector<Gid> readers, writers;
};
struct Graph {
  static constexpr const char* kName = "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_";
  Gid gid{};
  std::vector<NodeEntities> nodes;
};

// One walk over the fields for both directions: Archive >> or <<.
struct Writing {
  Cdr& cdr;
  template <class T>
  void operator()(T& value) { cdr << value; }
  template <class T, class Each>
  void list(std::vector<T>& values, Each each) {
    cdr << static_cast<uint32_t>(values.size());
    for (T& value : values) each(value);
  }
};
struct Reading {
  Cdr& cdr;
  template <class T>
  void operator()(T& value) { cdr >> value; }
  template <class T, class Each>
  void list(std::vector<T>& values, Each each) {
    uint32_t size = 0;
    cdr >> size;
    values.resize(size);
    for (T& value : values) each(value);
  }
};
template <class Archive>
void walk(Archive a, Stamp& m) { a(m.sec), a(m.nanosec); }
template <class Archive>
void walk(Archive a, JointState& m) {
  walk(a, m.stamp), a(m.frame_id), a(m.name), a(m.position), a(m.velocity), a(m.effort);
}
template <class Archive>
void walk(Archive a, Bool& m) { a(m.data); }
template <class Archive>
void walk(Archive a, String& m) { a(m.data); }
template <class Archive>
void walk(Archive a, Diagnostics& m) {
  walk(a, m.stamp), a(m.frame_id);
  a.list(m.status, [&](Status& s) {
    a(s.level), a(s.name), a(s.message), a(s.hardware_id);
    a.list(s.values, [&](std::array<std::string, 2>& pair) { a(pair[0]), a(pair[1]); });
  });
}
template <class Archive>
void walk(Archive a, Graph& m) {
  a(m.gid);
  a.list(m.nodes, [&](NodeEntities& n) {
    a(n.space), a(n.name);
    a.list(n.readers, [&](Gid& gid) { a(gid); });
    a.list(n.writers, [&](Gid& gid) { a(gid); });
  });
}

template <class T>
class Type : public fast::TopicDataType {
 public:
  Type() {
    setName(T::kName);
    m_typeSize = 1 << 16;  // the largest message, with its 4 bytes of encapsulation
    auto_fill_type_object(false);
    auto_fill_type_information(false);
  }
  bool serialize(void* data, rtps::SerializedPayload_t* payload) override {
    eprosima::fastcdr::FastBuffer buffer(reinterpret_cast<char*>(payload->data), payload->max_size);
    Cdr cdr(buffer, Cdr::DEFAULT_ENDIAN, Cdr::DDS_CDR);
    cdr.serialize_encapsulation();
    payload->encapsulation = cdr.endianness() == Cdr::BIG_ENDIANNESS ? CDR_BE : CDR_LE;
    walk(Writing{cdr}, *static_cast<T*>(data));
    payload->length = static_cast<uint32_t>(cdr.getSerializedDataLength());
    return true;
  }
  bool deserialize(rtps::SerializedPayload_t* payload, void* data) override {
    eprosima::fastcdr::FastBuffer buffer(reinterpret_cast<char*>(payload->data), payload->length);
    Cdr cdr(buffer, Cdr::DEFAULT_ENDIAN, Cdr::DDS_CDR);
    try {
      cdr.read_encapsulation();
      walk(Reading{cdr}, *static_cast<T*>(data));
    } catch (const eprosima::fastcdr::exception::Exception&) {
      return false;
    }
    return true;
  }
  std::function<uint32_t()> getSerializedSizeProvider(void*) override {
    return [this] { return m_typeSize; };
  }
  void* createData() override { return new T; }
  void deleteData(void* data) override { delete static_cast<T*>(data); }
  bool getKey(void*, rtps::InstanceHandle_t*, bool) override { return false; }
};

// Takes everything, in a thread of Fast DDS.
template <class T>
class Inbox : public fast::DataReaderListener {
 public:
  void on_data_available(fast::DataReader* reader) override {
    T message;
    fast::SampleInfo info;
    while (reader->take_next_sample(&message, &info) == eprosima::fastrtps::types::ReturnCode_t::RETCODE_OK) {
      if (!info.valid_data) continue;
      const std::lock_guard lock(mutex_);
      messages_.push_back(message);
    }
  }
  std::vector<T> all() {
    const std::lock_guard lock(mutex_);
    return messages_;
  }

 private:
  std::mutex mutex_;
  std::vector<T> messages_;
};

std::string quoted(const std::string& text) {
  std::string out = "\"";
  for (const char c : text) {
    if (c == '"' || c == '\\') out += '\\';
    out += c;
  }
  return out + '"';
}
std::string shown(double value) {
  if (!std::isfinite(value)) return "null";
  char text[32];
  std::snprintf(text, sizeof text, "%.17g", value);
  return text;
}
template <class T, class Each>
std::string shown(const std::vector<T>& values, Each each) {
  std::string out = "[";
  for (const T& value : values) out += (out.size() > 1 ? "," : "") + each(value);
  return out + "]";
}
std::string shown(const Stamp& stamp) {
  return std::to_string(int64_t{stamp.sec} * 1'000'000'000 + stamp.nanosec);
}

class Peer {
 public:
  explicit Peer(int domain) {
    fast::DomainParticipantQos qos;
    // The loopback interface alone, without multicast or shared memory, as the monitor's side is set up in the test.
    auto udp = std::make_shared<eprosima::fastdds::rtps::UDPv4TransportDescriptor>();
    udp->interfaceWhiteList = {"127.0.0.1"};
    qos.transport().use_builtin_transports = false;
    qos.transport().user_transports.push_back(udp);
    for (int index = 0; index < 40; ++index) {
      rtps::Locator_t locator;
      eprosima::fastrtps::rtps::IPLocator::setIPv4(locator, "127.0.0.1");
      locator.port = static_cast<uint32_t>(7410 + 250 * domain + 2 * index);
      qos.wire_protocol().builtin.initialPeersList.push_back(locator);
    }
    participant_ = fast::DomainParticipantFactory::get_instance()->create_participant(domain, qos);
    if (!participant_) throw std::runtime_error("no participant");
  }
  ~Peer() {
    participant_->delete_contained_entities();
    fast::DomainParticipantFactory::get_instance()->delete_participant(participant_);
  }
  template <class T>
  fast::DataReader* listen(const std::string& topic, bool latched, Inbox<T>& inbox) {
    fast::DataReaderQos qos;
    qos.reliability().kind = fast::RELIABLE_RELIABILITY_QOS;
    qos.durability().kind = latched ? fast::TRANSIENT_LOCAL_DURABILITY_QOS : fast::VOLATILE_DURABILITY_QOS;
    qos.history().kind = fast::KEEP_ALL_HISTORY_QOS;
    qos.endpoint().history_memory_policy = rtps::PREALLOCATED_WITH_REALLOC_MEMORY_MODE;
    auto* subscriber = participant_->create_subscriber(fast::SUBSCRIBER_QOS_DEFAULT);
    return subscriber->create_datareader(named<T>(topic), qos, &inbox);
  }
  template <class T>
  fast::DataWriter* speak(const std::string& topic) {
    fast::DataWriterQos qos;
    qos.reliability().kind = fast::RELIABLE_RELIABILITY_QOS;
    qos.durability().kind = fast::VOLATILE_DURABILITY_QOS;
    qos.history().depth = 100;
    qos.endpoint().history_memory_policy = rtps::PREALLOCATED_WITH_REALLOC_MEMORY_MODE;
    auto* publisher = participant_->create_publisher(fast::PUBLISHER_QOS_DEFAULT);
    return publisher->create_datawriter(named<T>(topic), qos);
  }

 private:
  template <class T>
  fast::Topic* named(const std::string& topic) {
    fast::TypeSupport type(new Type<T>);
    type.register_type(participant_);
    return participant_->create_topic(topic, T::kName, fast::TOPIC_QOS_DEFAULT);
  }
  fast::DomainParticipant* participant_ = nullptr;
};

JointState state(int64_t k) {
  constexpr double kSpeed[] = {2.3, 0.5, 1.1}, kPhase[] = {1.9, 0.0, 0.3};
  const double t = static_cast<double>(k) * 1e-3;
  JointState made;
  made.stamp = {1'700'000'000 + static_cast<int32_t>(k / 1000), static_cast<uint32_t>(k % 1000) * 1'000'000};
  made.name = {"elbow", "hand", "shoulder"};
  for (int j = 0; j < 3; ++j) {
    made.position.push_back(std::sin(kSpeed[j] * t + kPhase[j]));
    made.velocity.push_back(kSpeed[j] * std::cos(kSpeed[j] * t + kPhase[j]));
    made.effort.push_back(j == 2 && k >= 2000 && k < 2300 ? -12.0 : 0.0);
  }
  return made;
}

bool met(fast::DataWriter* writer) {
  fast::PublicationMatchedStatus status;
  writer->get_publication_matched_status(status);
  return status.current_count > 0;
}
bool met(fast::DataReader* reader) {
  fast::SubscriptionMatchedStatus status;
  reader->get_subscription_matched_status(status);
  return status.current_count > 0;
}

}  // namespace

int main(int argc, char** argv) {
  using namespace std::chrono;
  if (argc != 5) return std::fprintf(stderr, "usage: fastdds_peer DOMAIN NAMESPACE TOPIC SAMPLES\n"), 2;
  const std::string space = std::string("rt") + argv[2], topic = std::string("rt") + argv[3];
  const int64_t samples = std::atoll(argv[4]);

  Inbox<JointState> torques;
  Inbox<Bool> contacts, collisions;
  Inbox<String> events;
  Inbox<Diagnostics> diagnostics;
  Inbox<Graph> graph;
  {
    Peer peer(std::atoi(argv[1]));
    std::vector<fast::DataReader*> readers = {
        peer.listen(space + "/external_torque", false, torques), peer.listen(space + "/contact", true, contacts),
        peer.listen(space + "/collision", true, collisions),     peer.listen(space + "/event", false, events),
        peer.listen(space + "/diagnostics", false, diagnostics), peer.listen("ros_discovery_info", true, graph)};
    auto* states = peer.speak<JointState>(topic);
    auto* profile = peer.speak<String>(space + "/profile");
    auto* acknowledge = peer.speak<Bool>(space + "/acknowledge");
    auto* resume = peer.speak<Bool>(space + "/resume");

    const auto give_up = steady_clock::now() + 15s;
    const auto all_met = [&] {
      for (auto* reader : readers)
        if (!met(reader)) return false;
      return met(states) && met(profile) && met(acknowledge) && met(resume);
    };
    while (!all_met()) {
      if (steady_clock::now() > give_up) return std::fprintf(stderr, "fastdds_peer: the monitor was not met\n"), 1;
      std::this_thread::sleep_for(10ms);
    }
    // The monitor may meet these writers a moment after they have met it: what must arrive is sent again.
    String careful{"careful"};
    auto due = steady_clock::now();
    for (int64_t k = 0; k < samples; ++k, due += 1ms) {
      JointState message = state(k);
      states->write(&message);
      if (k % 500 == 0 && k < 2000) profile->write(&careful);
      if (k == samples - 500) {
        Bool yes{true};
        acknowledge->write(&yes);
        resume->write(&yes);
      }
      std::this_thread::sleep_until(due);
    }
    std::this_thread::sleep_for(300ms);
  }
  const auto boolean = [](const Bool& m) { return std::string(m.data ? "true" : "false"); };
  std::printf("{\"torques\":%s,", shown(torques.all(), [](const JointState& m) {
                return "{\"t_ns\":" + shown(m.stamp) + ",\"name\":" + shown(m.name, quoted) +
                       ",\"others\":" + std::to_string(m.position.size() + m.velocity.size()) +
                       ",\"effort\":" + shown(m.effort, [](double value) { return shown(value); }) + "}";
              }).c_str());
  std::printf("\"contact\":%s,\"collision\":%s,\"event\":%s,", shown(contacts.all(), boolean).c_str(),
              shown(collisions.all(), boolean).c_str(),
              shown(events.all(), [](const String& m) { return quoted(m.data); }).c_str());
  std::printf("\"diagnostics\":%s,", shown(diagnostics.all(), [](const Diagnostics& m) {
                return shown(m.status, [](const Status& s) {
                  return "{\"level\":" + std::to_string(s.level) + ",\"name\":" + quoted(s.name) +
                         ",\"message\":" + quoted(s.message) + ",\"hardware_id\":" + quoted(s.hardware_id) +
                         ",\"values\":" + shown(s.values, [](const std::array<std::string, 2>& pair) {
                           return "[" + quoted(pair[0]) + "," + quoted(pair[1]) + "]";
                         }) + "}";
                });
              }).c_str());
  std::printf("\"nodes\":%s}\n", shown(graph.all(), [](const Graph& m) {
                return shown(m.nodes, [](const NodeEntities& n) {
                  return "{\"space\":" + quoted(n.space) + ",\"name\":" + quoted(n.name) +
                         ",\"readers\":" + std::to_string(n.readers.size()) +
                         ",\"writers\":" + std::to_string(n.writers.size()) + "}";
                });
              }).c_str());
  return 0;
}
