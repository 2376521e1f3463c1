/* A camera behind xiAPI's functions: what drivers/camera/xiapi/driver.py talks to in the tests.
 *
 * Written from xiApi.h (XIMEA), not from the library: functions, structure and numbers are that header's. How
 * the real library behaves where the header says nothing is this file's guess; each guess is marked so.
 *
 * Time is the test's: stub_edge(ns) is an edge on the trigger input at that time of the camera's clock, and its
 * image can be fetched at once. The sensor takes SHORTEST_NS from frame to frame, and GAP_NS from the end of an
 * exposure to the start of the next.
 */
#include <pthread.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

typedef int XI_RETURN;
typedef uint32_t DWORD;
typedef void *HANDLE;

enum { XI_OK = 0, XI_INVALID_HANDLE = 1, XI_TIMEOUT = 10, XI_INVALID_ARG = 11, XI_ACQUISITION_ALREADY_UP = 41,
       XI_ACQUISITION_STOPED = 45, XI_NO_DEVICES_FOUND = 56, XI_LOCKED = 57, XI_BUFFER_SIZE_TOO_SMALL = 58,
       XI_UNKNOWN_PARAM = 100, XI_WRONG_PARAM_TYPE = 103, XI_NOT_SUPPORTED_PARAM_INFO = 107,
       XI_READ_ONLY_PARAM = 109, XI_PARAM_NOT_SETTABLE = 114, XI_OUT_OF_RANGE = 205 };

typedef struct {
    DWORD size;
    void *bp;
    DWORD bp_size, frm, width, height, nframe, tsSec, tsUSec, GPI_level, black_level, padding_x;
    DWORD AbsoluteOffsetX, AbsoluteOffsetY, transport_frm, img_desc[28], DownsamplingX, DownsamplingY, flags;
    DWORD exposure_time_us;
    float gain_db;
    DWORD acq_nframe, image_user_data, exposure_sub_times_us[5];
    double data_saturation;
    float wb_red, wb_green, wb_blue;
    DWORD lg_black_level, hg_black_level, lg_range, hg_range;
    float gain_ratio, fDownsamplingX, fDownsamplingY;
    DWORD color_filter_array;
} XI_IMG;

enum { RAW16 = 6, SAFE = 1, GBRG = 6 };
enum { TRIGGER_OFF = 0, TRIGGER_RISING = 1, TRIGGER_SOFTWARE = 3 };
enum { EXPOSURE_ACTIVE = 1, PREV_FRAME = 2, WHITE = 4095 };
enum { SKIPPED_TRANSPORT, SKIPPED_API, TRANSFERRED, MISSED_OVERLAP, MISSED_FULL, OVERFLOWS, COUNTERS };

#define SHORTEST_NS 10000000ull
#define GAP_NS 100000ull
#define LIMITED_NS 40000000ull /* while the frame rate is limited */
#define PULSE_US 50            /* of the box's trigger */
#define SENSOR_WIDTH 40
#define SENSOR_HEIGHT 24
#define LARGEST_QUEUE 4096

/* -- parameters ------------------------------------------------------------------------------------------ */

typedef struct {
    const char *name;
    double value, least, most;
    int flags;
} Parameter;
enum { READ_ONLY = 1, WHILE_ACQUIRING = 2 };

static const Parameter FACTORY[] = {
    {"exposure", 10000, 29, 1000000, WHILE_ACQUIRING},
    {"gain", 0, -1.5, 6.0, WHILE_ACQUIRING},
    {"width", SENSOR_WIDTH, 16, SENSOR_WIDTH, 0},
    {"height", SENSOR_HEIGHT, 2, SENSOR_HEIGHT, 0},
    {"offsetX", 0, 0, SENSOR_WIDTH, 0},
    {"offsetY", 0, 0, SENSOR_HEIGHT, 0},
    {"imgdataformat", 5, 0, 16, 0},
    {"imgpayloadsize", 0, 0, 1e9, READ_ONLY},
    {"sensor_bit_depth", 10, 8, 12, 0},
    {"output_bit_depth", 10, 8, 12, 0},
    {"image_data_bit_depth", 10, 8, 16, READ_ONLY},
    {"output_bit_packing", 0, 0, 1, 0},
    {"cfa", GBRG, 0, 8, READ_ONLY},
    {"image_black_level", 64, 0, 4095, READ_ONLY},
    {"aeag", 1, 0, 1, 0},
    {"downsampling", 1, 1, 2, 0},
    {"binning_selector", 0, 0, 2, 0},
    {"binning_horizontal", 1, 1, 2, 0},
    {"binning_vertical", 1, 1, 2, 0},
    {"decimation_horizontal", 1, 1, 2, 0},
    {"decimation_vertical", 1, 1, 2, 0},
    {"horizontal_flip", 0, 0, 1, 0},
    {"vertical_flip", 0, 0, 1, 0},
    {"test_pattern_generator_selector", 0, 0, 1, 0},
    {"test_pattern", 0, 0, 6, 0},
    {"LUTEnable", 0, 0, 1, 0},
    {"acq_timing_mode", 0, 0, 2, 0},
    {"exposure_burst_count", 1, 1, 16, 0},
    {"gain_selector", 0, 0, 2, 0},
    {"trigger_delay", 0, 0, 1000000, 0},
    {"dbnc_en", 0, 0, 1, 0},
    {"shutter_type", 0, 0, 2, 0},
    {"concat_img_mode", 0, 0, 1, 0},
    {"auto_wb", 0, 0, 1, 0},
    {"bpc", 0, 0, 1, 0},
    {"ffc", 0, 0, 1, 0},
    {"hdr", 0, 0, 1, 0},
    {"gammaY", 1, 0, 1, 0},
    {"gammaC", 1, 0, 1, 0},
    {"trans_data_black_level_ovr_en", 0, 0, 1, 0},
    {"exposure_time_selector", 0, 0, 2, 0},
    {"interline_exposure_mode", 0, 0, 1, 0},
    {"trigger_source", TRIGGER_OFF, 0, 5, 0},
    {"trigger_selector", 0, 0, 7, 0},
    {"trigger_overlap", 0, 0, 2, 0},
    {"trigger_software", 0, 0, 1, WHILE_ACQUIRING},
    {"gpi_selector", 1, 1, 6, 0},
    {"gpi_mode", 0, 0, 2, 0},
    {"gpo_selector", 1, 1, 6, 0},
    {"gpo_mode", 0, 0, 18, 0},
    {"framerate", 100, 1, 100, 0},
    {"buffer_policy", 0, 0, 1, 0},
    {"acq_buffer_size_unit", 1, 1, 1048576, 0},
    {"acq_buffer_size", 53248000, 1, 2147483647, 0},
    {"buffers_queue_size", 4, 2, LARGEST_QUEUE, 0},
    {"recent_frame", 1, 0, 1, 0},
    {"counter_selector", 0, 0, COUNTERS - 1, WHILE_ACQUIRING},
    {"counter_value", 0, 0, 4294967295.0, READ_ONLY},
    {"isexist", 1, 0, 1, READ_ONLY},
    {"chip_temp", 41.5, -50, 150, READ_ONLY},
};
#define PARAMETERS (sizeof FACTORY / sizeof *FACTORY)
static const char *TEXTS[][2] = {
    {"device_name", "CB120CG-CM stand-in"}, {"device_sn", "00000120"}, {"api_version", "4.27"}};

/* -- state ----------------------------------------------------------------------------------------------- */

typedef struct {
    uint64_t start_ns;
    DWORD number, id;
    int as_asked; /* exposed for 2 ms, without gain */
} Exposed;

static pthread_mutex_t mutex = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t arrived = PTHREAD_COND_INITIALIZER;
static Parameter parameters[PARAMETERS];
static int opened, acquiring, unplugged, ticks, ramp, latched;
static double gains[3];
static double input_modes[7], patterns[2];
static DWORD devices, exposures, acquired, padding_bytes, black_offset;
static uint64_t now_ns, ready_ns, exposure_end_ns;
static DWORD counters[COUNTERS], to_lose, to_overflow, to_miss;
static Exposed queue[LARGEST_QUEUE];
static unsigned queued, first;

static Parameter *find(const char *name) {
    for (unsigned k = 0; k < PARAMETERS; k++)
        if (!strcmp(parameters[k].name, name)) return &parameters[k];
    return NULL;
}

static DWORD whole(const char *name) { return (DWORD)find(name)->value; }

static DWORD factor(int across) {
    return whole("downsampling") * whole(across ? "binning_horizontal" : "binning_vertical") *
           whole(across ? "decimation_horizontal" : "decimation_vertical");
}

static DWORD image_bytes(void) { return whole("height") * (2 * whole("width") + padding_bytes); }

static double queue_limit(void) {
    double bytes = find("acq_buffer_size")->value * find("acq_buffer_size_unit")->value;
    double images = bytes / image_bytes();
    return images < LARGEST_QUEUE ? (double)(DWORD)images : LARGEST_QUEUE;
}

/* An edge or a software trigger, as sensor and transport see it. */
static void expose(uint64_t at_ns) {
    double exposure_us = find("exposure")->value * whole("exposure_burst_count") * (1 + whole("aeag"));
    if (whole("trigger_selector") == EXPOSURE_ACTIVE) exposure_us = PULSE_US;
    uint64_t exposure_ns = (uint64_t)(exposure_us * 1000);
    uint64_t free_ns = exposure_end_ns + GAP_NS > ready_ns ? exposure_end_ns + GAP_NS : ready_ns;
    if (at_ns < free_ns) {
        if (whole("trigger_overlap") != PREV_FRAME || latched) {
            counters[MISSED_OVERLAP]++;
            return;
        }
        latched = 1;
        at_ns = free_ns;
    } else {
        latched = 0;
    }
    if (to_miss) {
        to_miss--;
        counters[MISSED_FULL]++;
        return;
    }
    ready_ns = at_ns + (whole("acq_timing_mode") ? LIMITED_NS : SHORTEST_NS);
    exposure_end_ns = at_ns + exposure_ns;
    Exposed image = {at_ns, exposures++, acquired++, exposure_us == 2000 && gains[0] + gains[1] + gains[2] == 0};
    if (to_lose) {
        to_lose--;
        counters[SKIPPED_TRANSPORT]++;
    } else if (to_overflow) {
        to_overflow--;
        counters[OVERFLOWS]++;
    } else {
        counters[TRANSFERRED]++; /* guess: counted whether or not the queue has room */
        if (queued < whole("buffers_queue_size")) {
            queue[(first + queued++) % LARGEST_QUEUE] = image;
            pthread_cond_broadcast(&arrived);
        } else {
            counters[SKIPPED_API]++;
        }
    }
}

/* -- xiAPI ----------------------------------------------------------------------------------------------- */

#define ENTER(handle) \
    pthread_mutex_lock(&mutex); \
    if (!opened || (handle) != (HANDLE)&opened) return leave(XI_INVALID_HANDLE)

static XI_RETURN leave(XI_RETURN code) {
    pthread_mutex_unlock(&mutex);
    return code;
}

XI_RETURN xiGetNumberDevices(DWORD *count) {
    *count = unplugged ? 0 : devices;
    return XI_OK;
}

XI_RETURN xiOpenDevice(DWORD index, HANDLE *handle) {
    pthread_mutex_lock(&mutex);
    if (unplugged || index >= devices) return leave(XI_NO_DEVICES_FOUND);
    if (opened) return leave(XI_LOCKED); /* guess: which code a second client gets */
    opened = 1; /* guess: the camera keeps what the last program set */
    *handle = &opened;
    return leave(XI_OK);
}

XI_RETURN xiOpenDeviceBy(DWORD how, const char *serial, HANDLE *handle) {
    if (how != 1) return XI_INVALID_ARG;
    return strcmp(serial, TEXTS[1][1]) ? XI_NO_DEVICES_FOUND : xiOpenDevice(0, handle);
}

XI_RETURN xiCloseDevice(HANDLE handle) {
    ENTER(handle);
    opened = acquiring = 0;
    return leave(XI_OK);
}

/* Upper limit of a parameter, which may depend on others. */
static double most_of(const Parameter *parameter) {
    const char *name = parameter->name;
    if (!strcmp(name, "buffers_queue_size")) return queue_limit();
    if (!strcmp(name, "width")) return SENSOR_WIDTH / factor(1) - whole("offsetX");
    if (!strcmp(name, "height")) return SENSOR_HEIGHT / factor(0) - whole("offsetY");
    if (!strcmp(name, "offsetX")) return SENSOR_WIDTH / factor(1) - whole("width");
    if (!strcmp(name, "offsetY")) return SENSOR_HEIGHT / factor(0) - whole("height");
    return parameter->most;
}

/* Where a parameter's value is: some have one for each value of their selector. */
static double *place_of(Parameter *parameter) {
    if (!strcmp(parameter->name, "gain")) return &gains[whole("gain_selector")];
    if (!strcmp(parameter->name, "gpi_mode")) return &input_modes[whole("gpi_selector")];
    if (!strcmp(parameter->name, "test_pattern")) return &patterns[whole("test_pattern_generator_selector")];
    return &parameter->value;
}

/* An image that has become larger than the sensor gives is made whole; a smaller one stays as it is. */
static void fit_image(void) {
    if (whole("width") + whole("offsetX") > SENSOR_WIDTH / factor(1))
        find("offsetX")->value = 0, find("width")->value = SENSOR_WIDTH / factor(1);
    if (whole("height") + whole("offsetY") > SENSOR_HEIGHT / factor(0))
        find("offsetY")->value = 0, find("height")->value = SENSOR_HEIGHT / factor(0);
}

static XI_RETURN set(HANDLE handle, const char *name, double value) {
    ENTER(handle);
    Parameter *parameter = find(name);
    if (!parameter) return leave(XI_UNKNOWN_PARAM);
    if (parameter->flags & READ_ONLY) return leave(XI_READ_ONLY_PARAM);
    if (acquiring && !(parameter->flags & WHILE_ACQUIRING)) return leave(XI_PARAM_NOT_SETTABLE);
    double most = most_of(parameter);
    if (value < parameter->least || value > most) return leave(XI_OUT_OF_RANGE);
    if (!strcmp(name, "trigger_software")) {
        if (acquiring) expose(now_ns += SHORTEST_NS + (uint64_t)(find("exposure")->value * 1000) + GAP_NS);
        return leave(XI_OK);
    }
    *place_of(parameter) = value;
    if (strstr(name, "ing_") || !strcmp(name, "downsampling")) fit_image();
    if (!strcmp(name, "output_bit_depth")) find("image_data_bit_depth")->value = value;
    return leave(XI_OK);
}

XI_RETURN xiSetParamInt(HANDLE handle, const char *name, int value) { return set(handle, name, value); }
XI_RETURN xiSetParamFloat(HANDLE handle, const char *name, float value) { return set(handle, name, value); }
XI_RETURN xiSetParamString(HANDLE handle, const char *name, void *value, DWORD size) {
    (void)handle, (void)name, (void)value, (void)size;
    return XI_WRONG_PARAM_TYPE;
}

static XI_RETURN get(HANDLE handle, const char *asked, double *value) {
    char name[64];
    ENTER(handle);
    snprintf(name, sizeof name, "%s", asked);
    char *info = strchr(name, ':');
    if (info) *info++ = 0;
    Parameter *parameter = find(name);
    if (!parameter) return leave(XI_UNKNOWN_PARAM);
    *value = *place_of(parameter);
    if (info && !strcmp(info, "min")) *value = parameter->least;
    else if (info && !strcmp(info, "max"))
        *value = most_of(parameter);
    else if (info) return leave(XI_NOT_SUPPORTED_PARAM_INFO);
    else if (!strcmp(name, "imgpayloadsize")) *value = image_bytes();
    else if (!strcmp(name, "counter_value")) *value = counters[whole("counter_selector")];
    else if (!strcmp(name, "isexist")) *value = !unplugged;
    return leave(XI_OK);
}

XI_RETURN xiGetParamInt(HANDLE handle, const char *name, int *value) {
    double found = 0;
    XI_RETURN code = get(handle, name, &found);
    *value = (int)found;
    return code;
}

XI_RETURN xiGetParamFloat(HANDLE handle, const char *name, float *value) {
    double found = 0;
    XI_RETURN code = get(handle, name, &found);
    *value = (float)found;
    return code;
}

XI_RETURN xiGetParamString(HANDLE handle, const char *name, void *value, DWORD size) {
    ENTER(handle);
    for (unsigned k = 0; k < sizeof TEXTS / sizeof *TEXTS; k++)
        if (!strcmp(TEXTS[k][0], name)) {
            snprintf(value, size, "%s", TEXTS[k][1]);
            return leave(XI_OK);
        }
    return leave(XI_UNKNOWN_PARAM);
}

XI_RETURN xiStartAcquisition(HANDLE handle) {
    ENTER(handle);
    if (acquiring) return leave(XI_ACQUISITION_ALREADY_UP);
    queued = acquired = latched = 0;
    memset(counters, 0, sizeof counters); /* guess: all of them, as the header says of TRANSFERRED */
    acquiring = 1;
    return leave(XI_OK);
}

XI_RETURN xiStopAcquisition(HANDLE handle) {
    ENTER(handle);
    acquiring = 0;
    pthread_cond_broadcast(&arrived);
    return leave(XI_OK);
}

/* What a pixel of the image shows. The look-up table inverts, and a test pattern is white. */
static uint16_t shown(Exposed image, DWORD row, DWORD column) {
    if (!ramp) return (uint16_t)image.number;
    if (patterns[0] || patterns[1] || !image.as_asked) return WHITE;
    row = (row + whole("offsetY")) * factor(0), column = (column + whole("offsetX")) * factor(1);
    if (whole("vertical_flip")) row = SENSOR_HEIGHT - 1 - row;
    if (whole("horizontal_flip")) column = SENSOR_WIDTH - 1 - column;
    DWORD value = 1000 * image.number + SENSOR_WIDTH * row + column;
    return (uint16_t)(whole("LUTEnable") ? WHITE - value : value);
}

static void render(XI_IMG *out, Exposed image) {
    DWORD width = whole("width"), height = whole("height"), pitch = 2 * width + padding_bytes;
    for (DWORD row = 0; row < height; row++) {
        uint16_t *pixels = (uint16_t *)((char *)out->bp + row * pitch);
        for (DWORD column = 0; column < width; column++) pixels[column] = shown(image, row, column);
        memset(pixels + width, 0xEE, padding_bytes);
    }
    out->bp_size = height * pitch;
    out->frm = whole("imgdataformat");
    out->width = width;
    out->height = height;
    out->padding_x = padding_bytes;
    out->nframe = out->acq_nframe = image.id;
    out->tsSec = ticks ? (DWORD)(image.start_ns / 4 >> 32) : (DWORD)(image.start_ns / 1000000000u);
    out->tsUSec = ticks ? (DWORD)(image.start_ns / 4) : (DWORD)(image.start_ns % 1000000000u / 1000u);
    out->black_level = whole("image_black_level") + black_offset;
    out->exposure_time_us = whole("exposure");
    out->gain_db = (float)gains[0];
    out->color_filter_array = whole("cfa");
}

XI_RETURN xiGetImage(HANDLE handle, DWORD timeout_ms, XI_IMG *out) {
    ENTER(handle);
    if (whole("buffer_policy") != SAFE || whole("imgdataformat") != RAW16 || whole("recent_frame"))
        return leave(XI_INVALID_ARG); /* the stand-in knows this way only */
    if (out->size != sizeof *out || !out->bp) return leave(XI_INVALID_ARG);
    if (out->bp_size < image_bytes()) return leave(XI_BUFFER_SIZE_TOO_SMALL);
    struct timespec end;
    clock_gettime(CLOCK_REALTIME, &end);
    end.tv_sec += timeout_ms / 1000;
    end.tv_nsec += timeout_ms % 1000 * 1000000L;
    if (end.tv_nsec >= 1000000000L) end.tv_sec++, end.tv_nsec -= 1000000000L;
    while (acquiring && (unplugged || !queued))
        if (pthread_cond_timedwait(&arrived, &mutex, &end)) return leave(XI_TIMEOUT);
    if (!acquiring) return leave(XI_ACQUISITION_STOPED);
    render(out, queue[first]);
    first = (first + 1) % LARGEST_QUEUE;
    queued--;
    return leave(XI_OK);
}

/* -- the test's hands ------------------------------------------------------------------------------------ */

/* A camera as it leaves the factory, `count` of them connected. */
void stub_reset(DWORD count) {
    memcpy(parameters, FACTORY, sizeof FACTORY);
    memset(gains, 0, sizeof gains);
    memset(input_modes, 0, sizeof input_modes);
    memset(patterns, 0, sizeof patterns);
    opened = acquiring = unplugged = ticks = ramp = latched = 0;
    exposures = acquired = padding_bytes = black_offset = to_lose = to_overflow = to_miss = 0;
    now_ns = ready_ns = exposure_end_ns = queued = 0;
    devices = count;
}

/* An edge on an input, at a time of the camera's clock. */
void stub_edge(DWORD input, uint64_t at_ns) {
    pthread_mutex_lock(&mutex);
    now_ns = at_ns;
    if (acquiring && !unplugged && whole("trigger_source") == TRIGGER_RISING && input_modes[input] == 1)
        expose(at_ns + 1000ull * whole("trigger_delay") + 50000ull * whole("dbnc_en"));
    leave(XI_OK);
}

void stub_lose(DWORD images) { to_lose = images; }        /* on their way to the host */
void stub_overflow(DWORD images) { to_overflow = images; } /* in the camera's own memory */
void stub_miss(DWORD edges) { to_miss = edges; }          /* because the camera's memory is full */
void stub_pad(DWORD bytes) { padding_bytes = bytes; }     /* at the end of each row */
void stub_shift_black(DWORD dn) { black_offset = dn; }    /* of images, not of the parameter */
void stub_show_ramp(void) { ramp = 1; }                   /* in place of the image's number */
void stub_use_ticks(void) { ticks = 1; }                   /* of 4 ns, for timestamps */
void stub_unplug(void) { unplugged = 1; }
int stub_acquiring(void) { return acquiring; }
int stub_has_room(void) { return queued < whole("buffers_queue_size"); }
DWORD stub_parameter(const char *name) { return whole(name); }
DWORD stub_image_layout(int field) {
    XI_IMG image;
    char *start = (char *)&image;
    const char *fields[] = {start + sizeof image, (char *)&image.acq_nframe, (char *)&image.data_saturation,
                            (char *)&image.color_filter_array};
    return (DWORD)(fields[field] - start);
}
