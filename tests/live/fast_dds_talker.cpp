// Sends the bytes of one file as sensor_msgs/PointCloud2 by Fast DDS, as rmw_fastrtps does: 10 Hz on /points.
//   fast_dds_talker DOMAIN FILE COUNT reliable|best_effort
#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/topic/Topic.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>
#include <fastrtps/utils/IPLocator.h>

#include <chrono>
#include <cstring>
#include <fstream>
#include <functional>
#include <iterator>
#include <string>
#include <thread>
#include <vector>

using namespace eprosima::fastdds::dds;
using eprosima::fastrtps::rtps::SerializedPayload_t;
using Bytes = std::vector<char>;

class PointCloud2 : public TopicDataType
{
public:
  PointCloud2()
  {
    setName("sensor_msgs::msg::dds_::PointCloud2_");
    m_typeSize = 4000000;
    m_isGetKeyDefined = false;
  }
  bool serialize(void * data, SerializedPayload_t * payload) override
  {
    const Bytes & bytes = *static_cast<Bytes *>(data);
    std::memcpy(payload->data, bytes.data(), bytes.size());
    payload->length = static_cast<uint32_t>(bytes.size());
    payload->encapsulation = CDR_LE;
    return true;
  }
  bool deserialize(SerializedPayload_t *, void *) override { return false; }
  std::function<uint32_t()> getSerializedSizeProvider(void * data) override
  {
    return [data] { return static_cast<uint32_t>(static_cast<Bytes *>(data)->size()); };
  }
  void * createData() override { return new Bytes; }
  void deleteData(void * data) override { delete static_cast<Bytes *>(data); }
  bool getKey(void *, eprosima::fastrtps::rtps::InstanceHandle_t *, bool) override { return false; }
};

int main(int, char ** argv)
{
  std::ifstream file(argv[2], std::ios::binary);
  Bytes bytes((std::istreambuf_iterator<char>(file)), std::istreambuf_iterator<char>());
  DomainParticipantQos qos;
  auto udp = std::make_shared<eprosima::fastdds::rtps::UDPv4TransportDescriptor>();
  udp->interfaceWhiteList.push_back("127.0.0.1");
  qos.transport().use_builtin_transports = false;
  qos.transport().user_transports.push_back(udp);
  eprosima::fastrtps::rtps::Locator_t peer;
  eprosima::fastrtps::rtps::IPLocator::setIPv4(peer, 127, 0, 0, 1);
  qos.wire_protocol().builtin.initialPeersList.push_back(peer);
  auto participant = DomainParticipantFactory::get_instance()->create_participant(std::stoi(argv[1]), qos);
  TypeSupport type(new PointCloud2());
  type.register_type(participant);
  auto topic = participant->create_topic("rt/points", type.get_type_name(), TOPIC_QOS_DEFAULT);
  auto publisher = participant->create_publisher(PUBLISHER_QOS_DEFAULT);
  DataWriterQos writing = DATAWRITER_QOS_DEFAULT;
  bool reliable = std::string(argv[4]) == "reliable";
  writing.reliability().kind = reliable ? RELIABLE_RELIABILITY_QOS : BEST_EFFORT_RELIABILITY_QOS;
  writing.history().depth = 10;
  writing.publish_mode().kind = ASYNCHRONOUS_PUBLISH_MODE;
  writing.endpoint().history_memory_policy =
    eprosima::fastrtps::rtps::PREALLOCATED_WITH_REALLOC_MEMORY_MODE;
  auto writer = publisher->create_datawriter(topic, writing);
  PublicationMatchedStatus matched;
  do {
    std::this_thread::sleep_for(std::chrono::milliseconds(50));
    writer->get_publication_matched_status(matched);
  } while (matched.current_count == 0);
  for (int i = 0; i < std::stoi(argv[3]); ++i) {
    writer->write(&bytes);
    std::this_thread::sleep_for(std::chrono::milliseconds(100));
  }
  std::this_thread::sleep_for(std::chrono::seconds(1));
  return 0;
}
