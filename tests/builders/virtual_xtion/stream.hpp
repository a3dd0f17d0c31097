// One stream of a virtual camera: its modes and properties, and a frame made from a picture of the data.
#pragma once

#include <Driver/OniDriverAPI.h>
#include <fcntl.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <random>

#include "settings.hpp"

namespace vxtion {

constexpr int kWidth = 640, kHeight = 480;

inline uint64_t monotonicNs() {
	timespec now{};
	clock_gettime(CLOCK_MONOTONIC, &now);
	return static_cast<uint64_t>(now.tv_sec) * 1000000000ull + static_cast<uint64_t>(now.tv_nsec);
}

// A file of raw VGA pictures one after the other, mapped into memory.
class Pictures {
public:
	Pictures(const std::string& path, size_t bytesEach) : bytesEach_(bytesEach) {
		const int file = ::open(path.c_str(), O_RDONLY);
		if (file < 0) return;
		struct stat status {};
		if (fstat(file, &status) == 0 && static_cast<size_t>(status.st_size) >= bytesEach) {
			void* data = mmap(nullptr, static_cast<size_t>(status.st_size), PROT_READ, MAP_SHARED, file, 0);
			if (data != MAP_FAILED) {
				data_ = static_cast<const uint8_t*>(data);
				count_ = static_cast<size_t>(status.st_size) / bytesEach;
			}
		}
		::close(file);
	}

	const uint8_t* at(uint64_t index) const { return data_ ? data_ + (index % count_) * bytesEach_ : nullptr; }

private:
	size_t bytesEach_, count_ = 0;
	const uint8_t* data_ = nullptr;
};

template <typename T>
OniStatus give(void* data, int* size, const T& value) {
	if (*size < static_cast<int>(sizeof(T))) return ONI_STATUS_BAD_PARAMETER;
	std::memcpy(data, &value, sizeof(T));
	*size = sizeof(T);
	return ONI_STATUS_OK;
}

inline const std::vector<OniVideoMode>& modes(Kind kind) {
	static const std::vector<OniVideoMode> color = {{ONI_PIXEL_FORMAT_RGB888, 320, 240, 30},
	                                                {ONI_PIXEL_FORMAT_RGB888, 320, 240, 60},
	                                                {ONI_PIXEL_FORMAT_RGB888, 640, 480, 30}};
	static const std::vector<OniVideoMode> depth = {
	    {ONI_PIXEL_FORMAT_DEPTH_1_MM, 320, 240, 30},  {ONI_PIXEL_FORMAT_DEPTH_1_MM, 320, 240, 60},
	    {ONI_PIXEL_FORMAT_DEPTH_1_MM, 640, 480, 30},  {ONI_PIXEL_FORMAT_DEPTH_100_UM, 320, 240, 30},
	    {ONI_PIXEL_FORMAT_DEPTH_100_UM, 640, 480, 30}};
	return kind == kColor ? color : depth;
}

class Stream : public oni::driver::StreamBase {
public:
	Stream(Kind kind, int device)
	    : kind_(kind),
	      device_(device),
	      mode_(modes(kind)[0]),  // QVGA, as PS1080
	      pictures_(world().data + "/" + std::to_string(device) +
	                    (kind == kColor ? "/color_640x480.rgb" : "/depth_640x480.u16"),
	                static_cast<size_t>(kWidth * kHeight * bytesPerPixel())) {}

	Kind kind() const { return kind_; }
	bool running() const { return running_; }
	int bytesPerPixel() const { return kind_ == kColor ? 3 : 2; }
	int getRequiredFrameSize() override { return kWidth * kHeight * bytesPerPixel(); }

	OniStatus start() override {
		running_ = true;
		return ONI_STATUS_OK;
	}
	void stop() override { running_ = false; }

	OniBool isPropertySupported(int id) override {
		switch (id) {
			case ONI_STREAM_PROPERTY_CROPPING:
			case ONI_STREAM_PROPERTY_HORIZONTAL_FOV:
			case ONI_STREAM_PROPERTY_VERTICAL_FOV:
			case ONI_STREAM_PROPERTY_VIDEO_MODE:
			case ONI_STREAM_PROPERTY_STRIDE:
			case ONI_STREAM_PROPERTY_MIRRORING:
				return TRUE;
			case ONI_STREAM_PROPERTY_MAX_VALUE:
			case ONI_STREAM_PROPERTY_MIN_VALUE:
				return kind_ == kDepth;
			case ONI_STREAM_PROPERTY_AUTO_WHITE_BALANCE:
			case ONI_STREAM_PROPERTY_AUTO_EXPOSURE:
			case ONI_STREAM_PROPERTY_EXPOSURE:
			case ONI_STREAM_PROPERTY_GAIN:
				return kind_ == kColor;
			default:
				return FALSE;
		}
	}

	OniStatus getProperty(int id, void* data, int* size) override {
		if (!isPropertySupported(id)) return ONI_STATUS_NOT_SUPPORTED;
		switch (id) {
			case ONI_STREAM_PROPERTY_CROPPING:
				return give(data, size, OniCropping{FALSE, 0, 0, mode_.resolutionX, mode_.resolutionY});
			case ONI_STREAM_PROPERTY_HORIZONTAL_FOV:
				return give(data, size, 1.0144686f);
			case ONI_STREAM_PROPERTY_VERTICAL_FOV:
				return give(data, size, 0.7898090f);
			case ONI_STREAM_PROPERTY_VIDEO_MODE:
				return give(data, size, mode_);
			case ONI_STREAM_PROPERTY_STRIDE:
				return give(data, size, mode_.resolutionX * bytesPerPixel());
			case ONI_STREAM_PROPERTY_MIRRORING:
				return give(data, size, mirrored_ ? TRUE : FALSE);
			case ONI_STREAM_PROPERTY_MAX_VALUE:
				return give(data, size, 10000);
			case ONI_STREAM_PROPERTY_MIN_VALUE:
				return give(data, size, 0);
			case ONI_STREAM_PROPERTY_AUTO_EXPOSURE:
				return give(data, size, world().autoExposure[device_] ? TRUE : FALSE);
			case ONI_STREAM_PROPERTY_AUTO_WHITE_BALANCE:
				return give(data, size, world().autoWhite[device_] ? TRUE : FALSE);
			case ONI_STREAM_PROPERTY_EXPOSURE:
				return give(data, size, 20);
			default:
				return give(data, size, 150);
		}
	}

	OniStatus setProperty(int id, const void* data, int size) override {
		world().log("set " + std::to_string(device_) + (kind_ == kColor ? " color " : " depth ") + std::to_string(id));
		if (!world().faults[device_].plugged) return ONI_STATUS_NO_DEVICE;
		if (!isPropertySupported(id)) return ONI_STATUS_NOT_SUPPORTED;
		if (id == ONI_STREAM_PROPERTY_VIDEO_MODE && size == sizeof(OniVideoMode)) {
			if (running_) return ONI_STATUS_OUT_OF_FLOW;
			const auto& wanted = *static_cast<const OniVideoMode*>(data);
			for (const auto& mode : modes(kind_)) {
				if (std::memcmp(&mode, &wanted, sizeof(mode)) != 0) continue;
				mode_ = mode;
				return ONI_STATUS_OK;
			}
			return ONI_STATUS_NOT_SUPPORTED;
		}
		if (size != sizeof(int)) return ONI_STATUS_BAD_PARAMETER;
		const int value = *static_cast<const int*>(data);
		if (id == ONI_STREAM_PROPERTY_MIRRORING) {
			mirrored_ = value != 0 || listed("VXTION_MIRROR_STUCK", device_);
			return ONI_STATUS_OK;
		}
		const bool automatic = id == ONI_STREAM_PROPERTY_AUTO_EXPOSURE || id == ONI_STREAM_PROPERTY_AUTO_WHITE_BALANCE;
		if (automatic && !running_) return ONI_STATUS_ERROR;  // real cameras take it only while they stream
		if (id == ONI_STREAM_PROPERTY_AUTO_EXPOSURE) world().autoExposure[device_] = value != 0;
		if (id == ONI_STREAM_PROPERTY_AUTO_WHITE_BALANCE) world().autoWhite[device_] = value != 0;
		return ONI_STATUS_OK;
	}

	// Deliver exposure `index`, which shows picture `source` of the data.
	void deliver(uint64_t index, uint64_t source, uint64_t timestampUs, bool registered) {
		raise(mode_.resolutionX, mode_.resolutionY, timestampUs, [&](uint8_t* out) {
			paint(out, source, index, registered);
			if (world().stamp) {
				const uint64_t stamp[2] = {index, monotonicNs()};
				std::memcpy(out, stamp, sizeof(stamp));
			}
		});
	}

	// Deliver these pixels, of any size that fits.
	void deliver(const void* pixels, int width, int height, uint64_t timestampUs) {
		raise(width, height, timestampUs, [&](uint8_t* out) {
			std::memcpy(out, pixels, static_cast<size_t>(width * height * bytesPerPixel()));
		});
	}

private:
	template <typename Fill>
	void raise(int width, int height, uint64_t timestampUs, Fill fill) {
		OniFrame* frame = getServices().acquireFrame();
		if (frame == nullptr) return;
		frame->dataSize = width * height * bytesPerPixel();
		frame->sensorType = kind_ == kColor ? ONI_SENSOR_COLOR : ONI_SENSOR_DEPTH;
		frame->timestamp = timestampUs;
		frame->frameIndex = ++delivered_;
		frame->width = width;
		frame->height = height;
		frame->videoMode = mode_;
		frame->croppingEnabled = FALSE;
		frame->cropOriginX = frame->cropOriginY = 0;
		frame->stride = width * bytesPerPixel();
		fill(static_cast<uint8_t*>(frame->data));
		raiseNewFrame(frame);
		getServices().releaseFrame(frame);
	}

	void paint(uint8_t* out, uint64_t source, uint64_t index, bool registered) {
		const uint8_t* picture = pictures_.at(source);
		const int bytes = bytesPerPixel(), step = kWidth / mode_.resolutionX;
		const int shift = kind_ == kDepth && !registered ? 12 : 0;
		if (picture == nullptr || (kind_ == kDepth && !world().emitter[device_])) {
			std::memset(out, picture == nullptr ? 100 : 0, static_cast<size_t>(mode_.resolutionX * mode_.resolutionY * bytes));
		} else if (step == 1 && !mirrored_ && shift == 0) {
			std::memcpy(out, picture, static_cast<size_t>(kWidth * kHeight * bytes));
		} else {
			for (int y = 0; y < mode_.resolutionY; ++y)
				for (int x = 0; x < mode_.resolutionX; ++x) {
					const int turned = mirrored_ ? mode_.resolutionX - 1 - x : x;
					const int from = std::min(kWidth - 1, turned * step + shift);
					std::memcpy(out + (y * mode_.resolutionX + x) * bytes, picture + (y * step * kWidth + from) * bytes, bytes);
				}
		}
		if (kind_ == kColor && world().autoExposure[device_] && world().autoExposureShows)
			for (int i = 0; i < mode_.resolutionX * mode_.resolutionY * 3; ++i) out[i] = static_cast<uint8_t>(std::min(255, out[i] + 20));
		if (kind_ == kDepth && world().interference) punchHoles(reinterpret_cast<uint16_t*>(out), index);
	}

	// Other projectors that shine at the same time make holes: 1 in 32 pixels for each, others in each exposure.
	void punchHoles(uint16_t* out, uint64_t index) {
		int others = 0;
		for (int i = 0; i < world().devices; ++i) others += i != device_ && world().emitter[i];
		std::mt19937 random(static_cast<unsigned>(index) * 31u + static_cast<unsigned>(device_));
		for (int i = 0; i < mode_.resolutionX * mode_.resolutionY; ++i)
			if (static_cast<int>(random() & 31u) < others) out[i] = 0;
	}

	const Kind kind_;
	const int device_;
	OniVideoMode mode_;
	Pictures pictures_;
	std::atomic<bool> running_{false}, mirrored_{true};  // defaults of PS1080
	int delivered_ = 0;
};

}  // namespace vxtion
