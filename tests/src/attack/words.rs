//! Words of the formats, which the mutator inserts.
//!
//! The words of a format are one text, separated by `|`.

pub fn list(words: &[u8]) -> Vec<&[u8]> {
    words.split(|&byte| byte == b'|').filter(|word| !word.is_empty()).collect()
}

pub const PICKLE: &[u8] = b"\
    \x80\x02|]|}|)|(|q\x00|h\x00|r\xff\xff\xff\xff|j\xff\xff\xff\x7f|0|1|2|a|e|s|u|t|\x85|\x86|\x87|R|Q|\
    .|K\xff|J\xff\xff\xff\xff|\x8a\x08\xff\xff\xff\xff\xff\xff\xff\x7f|\x8a\xff|X\xff\xff\xff\xff|\
    X\xff\xff\xff\x7f|\x8c\xff|\x8d\xff\xff\xff\xff\xff\xff\xff\xff|G\x7f\xf8\x00\x00\x00\x00\x00\x00|\
    \x88|\x89|N|\x94|\x93|\x95\xff\xff\xff\xff\xff\xff\xff\x7f|b|cos\nsystem\n|\
    ctorch._utils\n_rebuild_tensor_v2\n|ctorch\nByteStorage\n|ctorch\nFloatStorage\n|\
    ccollections\nOrderedDict\n|((((((((|))))))))";

pub const JSON: &[u8] = b"\
    {|}|[|]|null|true|-1|1e400|\"\"|,|:|\\u0000|\xff|[[[[[[[[[[[[|{\"a\":{\"a\":{\"a\":|../../|\
    /dev/zero|\"context\"|\"target\"|\"num_tokens\"|\"offset_bytes\"";

pub const TOML: &[u8] = b"\
    [|]|[[|]]|=|\"\"\"|'|#|nan|-inf|inf|0x7fffffffffffffff|1e400|true|[model]\n|[data.views]\n|\
    [stage1.optimizer]\n|dim = 0\n|patch_size = 0\n|\xff|\n|{|}|num_heads = 0\n|grid = []\n|\
    [[[[[[[[[[[[[[[[|a.b.c.d.e.f = 1\n|\"1/0\"|2024-01-01T00:00:00Z";

pub const SAFETENSORS: &[u8] = b"\
    \"dtype\":\"F32\"|\"dtype\":\"F64\"|\"shape\":[|\"data_offsets\":[0,|__metadata__|{|}|\"F16\"|\
    18446744073709551615|4294967296|[0]|[]|\xff\xff\xff\xff\xff\xff\xff\x7f|\x00\x00\x80\x7f|NaN|\
    \x00\x00\xc0\x7f";

pub const PNG: &[u8] = b"IHDR|IDAT|PLTE|tRNS|IEND|acTL|fcTL|iCCP|\x00\x00\x40\x00|\x10|\x03";

pub const JPEG: &[u8] =
    b"\xff\xd8|\xff\xd9|\xff\xda|\xff\xc0|\xff\xc2|\xff\xc4|\xff\xdb|\xff\xdd\x00\x04|\xff\xe1|\xff";

pub const TRANSFORMS: &[u8] = b"\
    {|}|[|]|null|-1|1e400|1e-300|NaN|,|\"k1\": 1e9, |\"k1\": -0.3, |\"w\": 1e300, |\
    \"camera_angle_x\": 3.2, |\"file_path\": \"/dev/zero\"|../../|\\u0000|\xff|\"images\\\\8\"|\
    [[[[[[[[[[[[";

/// Numbers and paths of COLMAP's binary files.
pub const BINARY: &[u8] = b"\
    \x00\x00\x00\x00\x00\x00\xf0\x7f|\x00\x00\x00\x00\x00\x00\xf8\x7f|\xff\xff\xff\xff\xff\xff\xff\xff|\
    \xff\xff\xff\xff\xff\xff\xff\x7f|\xaa\xaa\xaa\xaa\xaa\xaa\xaa\x0a|\x00\x00\x00\x00|\x05\x00\x00\x00|\
    \x00|../|/dev/zero\x00";

/// Camera text files.
pub const TEXT: &[u8] = b"\n|\n\n|#| |nan|-inf|1e400|-1|OPENCV|FULL_OPENCV|../|/dev/zero|\xff|\0|9223372036854775808";
