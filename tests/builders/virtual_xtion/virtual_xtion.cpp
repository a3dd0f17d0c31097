// A driver for the stock OpenNI2 runtime with N virtual Xtions, so that capturing is tested without cameras.
// It serves raw pictures from a folder and makes faults on command; see settings.hpp for what can be asked of it.
#include "stream.hpp"

#include <chrono>
#include <condition_variable>
#include <list>
#include <memory>
#include <random>
#include <thread>

// The export macro takes these two from a private library of OpenNI's.
#define XN_NEW(type, ...) new type(__VA_ARGS__)
#define XN_DELETE(pointer) delete (pointer)

namespace vxtion {

constexpr int kEmitterState = 0x1080E007;
constexpr int kHostTimestamps = 0x1080FF77;

class Device : public oni::driver::DeviceBase {
public:
	explicit Device(int number) : number_(number) {
		for (Kind kind : {kColor, kDepth}) {
			auto& info = sensors_[kind];
			info.sensorType = kind == kColor ? ONI_SENSOR_COLOR : ONI_SENSOR_DEPTH;
			info.numSupportedVideoModes = static_cast<int>(modes(kind).size());
			info.pSupportedVideoModes = const_cast<OniVideoMode*>(modes(kind).data());
		}
		if (!world().byHand) thread_ = std::thread([this] { run(); });
	}

	~Device() override {
		alive_ = false;
		if (thread_.joinable()) thread_.join();
	}

	OniStatus getSensorInfoList(OniSensorInfo** sensors, int* count) override {
		*sensors = sensors_;
		*count = world().faults[number_].hasDepth ? 2 : 1;
		return ONI_STATUS_OK;
	}

	oni::driver::StreamBase* createStream(OniSensorType type) override {
		if (type != ONI_SENSOR_COLOR && type != ONI_SENSOR_DEPTH) return nullptr;
		auto* stream = new Stream(type == ONI_SENSOR_COLOR ? kColor : kDepth, number_);
		std::lock_guard<std::mutex> lock(mutex_);
		streams_.push_back(stream);
		return stream;
	}

	void destroyStream(oni::driver::StreamBase* stream) override {
		{
			std::lock_guard<std::mutex> lock(mutex_);
			streams_.remove(static_cast<Stream*>(stream));
		}
		delete stream;
	}

	// Give a frame to whoever streams, by hand.
	void send(Kind kind, const void* pixels, int width, int height, uint64_t timestampUs) {
		std::lock_guard<std::mutex> lock(mutex_);
		for (Stream* stream : streams_)
			if (stream->kind() == kind && stream->running()) stream->deliver(pixels, width, height, timestampUs);
	}

	bool is(int number) const { return number_ == number; }

	OniBool isImageRegistrationModeSupported(OniImageRegistrationMode mode) override {
		return mode == ONI_IMAGE_REGISTRATION_OFF || !listed("VXTION_NOREG", number_);
	}

	OniBool isPropertySupported(int id) override {
		return id == ONI_DEVICE_PROPERTY_FIRMWARE_VERSION || id == ONI_DEVICE_PROPERTY_DRIVER_VERSION ||
		       id == ONI_DEVICE_PROPERTY_HARDWARE_VERSION || id == ONI_DEVICE_PROPERTY_SERIAL_NUMBER ||
		       id == ONI_DEVICE_PROPERTY_IMAGE_REGISTRATION || id == kHostTimestamps || hasEmitter(id);
	}

	OniStatus getProperty(int id, void* data, int* size) override {
		if (!world().faults[number_].plugged) return ONI_STATUS_NO_DEVICE;
		switch (id) {
			case ONI_DEVICE_PROPERTY_FIRMWARE_VERSION:
				return giveText(data, size, "5.8.22");
			case ONI_DEVICE_PROPERTY_DRIVER_VERSION:
				return give(data, size, OniVersion{2, 2, 0, 33});
			case ONI_DEVICE_PROPERTY_HARDWARE_VERSION:
				return give(data, size, 6);
			case ONI_DEVICE_PROPERTY_SERIAL_NUMBER:
				if (listed("VXTION_NOSERIAL", number_)) return ONI_STATUS_ERROR;
				return giveText(data, size, serial());
			case ONI_DEVICE_PROPERTY_IMAGE_REGISTRATION:
				if (!has(kDepth)) return ONI_STATUS_BAD_PARAMETER;
				return give(data, size, registered_ ? ONI_IMAGE_REGISTRATION_DEPTH_TO_COLOR : ONI_IMAGE_REGISTRATION_OFF);
			case kHostTimestamps:
				return give(data, size, static_cast<uint64_t>(0));
			case kEmitterState:
				if (!hasEmitter(id)) return ONI_STATUS_NOT_SUPPORTED;
				if (*size == sizeof(uint64_t)) return give(data, size, static_cast<uint64_t>(world().emitter[number_]));
				return give(data, size, static_cast<int>(world().emitter[number_]));
			default:
				return ONI_STATUS_NOT_SUPPORTED;
		}
	}

	OniStatus setProperty(int id, const void* data, int size) override {
		world().log("set " + std::to_string(number_) + " device " + std::to_string(id));
		if (!world().faults[number_].plugged) return ONI_STATUS_NO_DEVICE;
		if (size < static_cast<int>(sizeof(int))) return ONI_STATUS_BAD_PARAMETER;
		const int value = *static_cast<const int*>(data);
		if (hasEmitter(id)) {
			world().emitter[number_] = value != 0;
			return ONI_STATUS_OK;
		}
		if (id != ONI_DEVICE_PROPERTY_IMAGE_REGISTRATION) return ONI_STATUS_NOT_SUPPORTED;
		if (!has(kDepth)) return ONI_STATUS_BAD_PARAMETER;
		if (!isImageRegistrationModeSupported(static_cast<OniImageRegistrationMode>(value))) return ONI_STATUS_NOT_SUPPORTED;
		registered_ = value == ONI_IMAGE_REGISTRATION_DEPTH_TO_COLOR;
		return ONI_STATUS_OK;
	}

private:
	struct Event {
		double raiseUs;
		Kind kind;
		uint64_t index, source, timestampUs;
	};

	static OniStatus giveText(void* data, int* size, const std::string& value) {
		if (*size <= static_cast<int>(value.size())) return ONI_STATUS_BAD_PARAMETER;
		std::memcpy(data, value.c_str(), value.size() + 1);
		*size = static_cast<int>(value.size()) + 1;
		return ONI_STATUS_OK;
	}

	std::string serial() const {
		const auto& named = world().serials;
		const auto n = static_cast<size_t>(number_);
		return n < named.size() ? named[n] : "VX000000" + std::to_string(1000 + number_);
	}

	bool hasEmitter(int id) const { return id == kEmitterState && !listed("VXTION_NOEMITTER", number_); }

	bool has(Kind kind) {
		std::lock_guard<std::mutex> lock(mutex_);
		return std::any_of(streams_.begin(), streams_.end(), [kind](Stream* s) { return s->kind() == kind; });
	}

	bool anyRunning() {
		std::lock_guard<std::mutex> lock(mutex_);
		return std::any_of(streams_.begin(), streams_.end(), [](Stream* s) { return s->running(); });
	}

	static double nowUs() { return static_cast<double>(monotonicNs()) * 1e-3; }

	uint64_t sourceAt(double exposureUs, uint64_t index) const {
		const long scene = world().scene;
		if (scene >= 0) return static_cast<uint64_t>(scene);
		if (world().hold <= 0) return index;
		return static_cast<uint64_t>((exposureUs - world().startedUs) / (kPeriodUs * static_cast<double>(world().hold)));
	}

	void run() {
		const double periodUs = kPeriodUs * (1 + 1e-6 * static_cast<double>(numberOf("VXTION_DRIFT_PPM", number_, 0)));
		const double phaseUs = static_cast<double>(numberOf("VXTION_PHASE_US", number_, 0));
		const double lagUs = static_cast<double>(numberOf("VXTION_COLOR_LAG_US", number_, 0));
		const double jitterUs = static_cast<double>(number("VXTION_JITTER_US", 0));
		std::mt19937 random(static_cast<unsigned>(number_ + 1));
		std::uniform_real_distribution<double> jitter(0, jitterUs);
		std::list<Event> pending;
		double firstUs = 0;
		uint64_t index = 0;
		for (bool streaming = false; alive_;) {
			if (!anyRunning()) {
				streaming = false;
				pending.clear();
				std::this_thread::sleep_for(std::chrono::milliseconds(2));
				continue;
			}
			if (!streaming) {  // exposures of all devices lie on one grid, each shifted by its phase
				streaming = true;
				index = 0;
				firstUs = world().startedUs + phaseUs + std::ceil((nowUs() - world().startedUs) / kPeriodUs) * kPeriodUs;
			}
			const double exposureUs = firstUs + static_cast<double>(index) * periodUs;
			while (!pending.empty() && pending.front().raiseUs <= exposureUs) {
				raise(pending.front());
				pending.pop_front();
			}
			sleepUntil(exposureUs);
			if (!alive_) return;
			const uint64_t source = sourceAt(exposureUs, index);
			const double deviceUs = static_cast<double>(index) * kPeriodUs;
			schedule(pending, {exposureUs + jitter(random), kDepth, index, source, static_cast<uint64_t>(deviceUs)});
			schedule(pending, {exposureUs + lagUs + jitter(random), kColor, index, source, static_cast<uint64_t>(deviceUs + lagUs)});
			++index;
		}
	}

	static void schedule(std::list<Event>& pending, const Event& event) {
		const auto later = [&](const Event& other) { return other.raiseUs > event.raiseUs; };
		pending.insert(std::find_if(pending.begin(), pending.end(), later), event);
	}

	static void sleepUntil(double timeUs) {
		const double left = timeUs - nowUs();
		if (left > 0) std::this_thread::sleep_for(std::chrono::microseconds(static_cast<long>(left)));
	}

	void raise(const Event& event) {
		auto& faults = world().faults[number_];
		sleepUntil(event.raiseUs);
		if (!faults.plugged || faults.stalled[event.kind]) return;
		if (faults.drop[event.kind] > 0) {
			--faults.drop[event.kind];
			return;
		}
		std::lock_guard<std::mutex> lock(mutex_);
		for (Stream* stream : streams_)
			if (stream->kind() == event.kind && stream->running()) stream->deliver(event.index, event.source, event.timestampUs, registered_);
	}

	const int number_;
	OniSensorInfo sensors_[2];
	std::atomic<bool> alive_{true}, registered_{false};
	std::mutex mutex_;
	std::list<Stream*> streams_;
	std::thread thread_;
};

class Driver : public oni::driver::DriverBase {
public:
	explicit Driver(OniDriverServices* services) : DriverBase(services) {}

	OniStatus initialize(oni::driver::DeviceConnectedCallback connected, oni::driver::DeviceDisconnectedCallback disconnected,
	                     oni::driver::DeviceStateChangedCallback changed, void* cookie) override {
		DriverBase::initialize(connected, disconnected, changed, cookie);
		world().startedUs = static_cast<double>(monotonicNs()) * 1e-3;
		std::lock_guard<std::mutex> lock(mutex_);
		instance_ = this;
		for (int i = 0; i < world().devices; ++i)
			if (world().faults[i].plugged) connect(i);
		running_ = true;
		thread_ = std::thread([this] { obey(); });
		return ONI_STATUS_OK;
	}

	oni::driver::DeviceBase* deviceOpen(const char* uri, const char*) override {
		const int number = numberIn(uri);
		if (number < 0 || !world().faults[number].plugged) return nullptr;
		if (listed("VXTION_FAIL_OPEN", number)) {
			getServices().errorLoggerAppend("Could not open \"%s\": USB interface was not found!", uri);
			return nullptr;
		}
		auto* device = new Device(number);
		std::lock_guard<std::mutex> lock(mutex_);
		open_.push_back(device);
		return device;
	}

	void deviceClose(oni::driver::DeviceBase* device) override {
		{
			std::lock_guard<std::mutex> lock(mutex_);
			open_.remove(static_cast<Device*>(device));
		}
		delete device;
	}
	OniStatus tryDevice(const char*) override { return ONI_STATUS_ERROR; }

	void* enableFrameSync(oni::driver::StreamBase** streams, int count) override {
		world().log("enableFrameSync " + std::to_string(count));
		return streams;
	}
	void disableFrameSync(void*) override {}

	void shutdown() override {
		{
			std::lock_guard<std::mutex> lock(mutex_);
			instance_ = nullptr;
		}
		running_ = false;
		if (thread_.joinable()) thread_.join();
	}

	// What the program that loaded the driver does by hand; without a running driver only the state of the world changes.
	static void plug(int number, bool plugged) {
		Driver* driver = nullptr;
		{
			std::lock_guard<std::mutex> lock(mutex_);
			driver = instance_;
		}
		if (world().faults[number].plugged.exchange(plugged) == plugged || driver == nullptr) return;
		const OniDeviceInfo info = describe(number);
		plugged ? driver->deviceConnected(&info) : driver->deviceDisconnected(&info);
	}

	static void send(int number, Kind kind, const void* pixels, int width, int height, uint64_t timestampUs) {
		std::lock_guard<std::mutex> lock(mutex_);
		if (!world().faults[number].plugged) return;
		for (Device* device : open_)
			if (device->is(number)) device->send(kind, pixels, width, height, timestampUs);
	}

private:
	static int numberIn(const std::string& uri) {
		const std::string start = "virtual://";
		if (uri.compare(0, start.size(), start) != 0) return -1;
		const int number = std::atoi(uri.c_str() + start.size());
		return number >= 0 && number < world().devices ? number : -1;
	}

	static OniDeviceInfo describe(int number) {
		OniDeviceInfo info{};
		std::snprintf(info.uri, sizeof(info.uri), "virtual://%d", number);
		std::snprintf(info.vendor, sizeof(info.vendor), "Virtual");
		std::snprintf(info.name, sizeof(info.name), "Virtual Xtion");
		info.usbVendorId = 0x1d27;
		info.usbProductId = 0x0600;
		return info;
	}

	void connect(int number) {
		const OniDeviceInfo info = describe(number);
		deviceConnected(&info);
	}

	void obey() {
		while (running_) {
			for (const std::string& line : control_.newLines()) obey(line);
			std::this_thread::sleep_for(std::chrono::milliseconds(20));
		}
	}

	void obey(const std::string& line) {
		std::istringstream words(line);
		std::string command, which;
		int number = 0, count = 0;
		words >> command >> number;
		world().log("command " + line);
		if (command == "scene") {
			world().scene = number;
			return;
		}
		if (number < 0 || number >= world().devices) return;
		auto& faults = world().faults[number];
		const OniDeviceInfo info = describe(number);
		if (command == "unplug" || command == "plug") {
			plug(number, command == "plug");
		} else if (command == "state" && words >> count) {
			deviceStateChanged(&info, count);
		} else if (words >> which) {
			words >> count;
			for (Kind kind : kinds(which)) {
				if (command == "stall") faults.stalled[kind] = true;
				if (command == "resume") faults.stalled[kind] = false;
				if (command == "drop") faults.drop[kind] = count;
			}
		}
	}

	static inline std::mutex mutex_;  // of the next two
	static inline Driver* instance_ = nullptr;
	static inline std::list<Device*> open_;
	ControlFile control_;
	std::atomic<bool> running_{false};
	std::thread thread_;
};

}  // namespace vxtion

// With VXTION_BY_HAND the program that loads the runtime loads this library too, and plays the cameras.
extern "C" {
void vxtion_plug(int device, int plugged) { vxtion::Driver::plug(device, plugged != 0); }

void vxtion_lock_exposure(int device) {
	vxtion::world().autoExposure[device] = false;
	vxtion::world().autoWhite[device] = false;
}

void vxtion_set_depth(int device, int hasDepth) { vxtion::world().faults[device].hasDepth = hasDepth != 0; }

// Bit 0: exposure, bit 1: white balance.
int vxtion_automatic(int device) {
	return (vxtion::world().autoExposure[device] ? 1 : 0) | (vxtion::world().autoWhite[device] ? 2 : 0);
}

void vxtion_send(int device, int kind, const void* pixels, int width, int height, uint64_t timestampUs) {
	vxtion::Driver::send(device, static_cast<vxtion::Kind>(kind), pixels, width, height, timestampUs);
}
}

ONI_EXPORT_DRIVER(vxtion::Driver)
